"""Make punch_*.msh: a piece of the half space z <= 0 around a disc of radius a (a strip in 2D).

    python meshes/half_space.py FILE [--cell quadrilateral] [--divisions 8] [--radius 0.01]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. Only the quarter x >= 0, y >= 0 is meshed (in 2D the half x >= 0, with y in
place of z). The grid follows oblate spheroidal coordinates, in which the solution below a flat
punch is smooth: elements shrink with the square root towards the edge of the disc, where the
pressure is infinite, and grow with the distance from it, up to the far boundary.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh
import numpy as np

FAR = 200.0  # distance of the far boundary, relative to the radius

# cell: dimension, Gmsh's numbers of the cell and of its facets, the nodes of its facets
CELLS = {
    "quadrilateral": (2, 3, 1, [[0, 1], [1, 2], [2, 3], [3, 0]]),
    "hexahedron": (
        3,
        5,
        3,
        [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]],
    ),
}
# Gmsh's order of the corners of a quadrilateral and a hexahedron, as steps along the axes
CORNERS = {
    2: [(0, 0), (1, 0), (1, 1), (0, 1)],
    3: [
        (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)
    ],
}  # fmt: skip


def grid(gdim: int, divisions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions (n, gdim) and depths (n,) of the nodes, and cells as rows of nodes.

    The directions are points of the sphere octant on the three faces of a cube, which are divided
    by equal angles; the depths are the spheroids' numbers, from the disc (0) to the far boundary.
    """
    tangent = np.tan(np.linspace(0, np.pi / 4, divisions + 1))
    last = np.arccosh(FAR)
    depth = np.linspace(0, last, round(last / (np.pi / 4 / divisions)) + 1)
    directions, depths, cells, start = [], [], [], 0
    for face in range(gdim):
        axes = [depth if axis == face else tangent for axis in range(gdim)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        number = np.arange(start, start + nodes[..., 0].size).reshape(nodes.shape[:-1])
        start += number.size
        corners = [
            number[tuple(slice(s, n - 1 + s) for s, n in zip(corner, number.shape, strict=True))]
            for corner in CORNERS[gdim]
        ]
        cells.append(np.stack(corners, axis=-1).reshape(-1, len(corners)))
        nodes = nodes.reshape(-1, gdim)
        depths.append(nodes[:, face].copy())
        nodes[:, face] = 1.0
        directions.append(nodes / np.linalg.norm(nodes, axis=1, keepdims=True))
    return np.concatenate(directions), np.concatenate(depths), np.concatenate(cells)


def half_space(
    output: Path, cell: str = "hexahedron", divisions: int = 8, radius: float = 0.01
) -> None:
    """Mesh it and write the file."""
    gdim, cell_type, facet_type, sides = CELLS[cell]
    directions, depths, cells = grid(gdim, divisions)
    columns = np.column_stack([directions, depths])
    _, first, place = np.unique(
        np.round(columns * 1e6), axis=0, return_index=True, return_inverse=True
    )
    directions, depths, cells = directions[first], depths[first], place.ravel()[cells]
    points = radius * directions * np.cosh(depths)[:, np.newaxis]
    points[:, -1] = -radius * directions[:, -1] * np.sinh(depths)

    facets = np.concatenate([cells[:, side] for side in sides])
    _, first, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True
    )
    facets = facets[first[count == 1]]

    def all_nodes(condition: np.ndarray) -> np.ndarray:
        return facets[condition[facets].all(axis=1)]

    groups = {
        "top": all_nodes((points[:, -1] == 0.0) & (np.cosh(depths) < 3)),
        "far": all_nodes(depths == depths.max()),
        "symmetry_x": all_nodes(directions[:, 0] == 0.0),
    }
    if gdim == 3:
        groups["symmetry_y"] = all_nodes(directions[:, 1] == 0.0)
    write(output, points, cells, groups, cell_type, facet_type)


def write(
    output: Path,
    points: np.ndarray,
    cells: np.ndarray,
    groups: dict[str, np.ndarray],
    cell_type: int,
    facet_type: int,
) -> None:
    """Write the body, of tag 1, and its facets as physical groups."""
    gdim = points.shape[1]
    gmsh.initialize(readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.add("half_space")
        gmsh.model.addDiscreteEntity(gdim, 1)
        xyz = np.pad(points, ((0, 0), (0, 3 - gdim)))
        gmsh.model.mesh.addNodes(gdim, 1, np.arange(1, len(points) + 1), xyz.ravel())
        parts = [(gdim, cell_type, "half space", cells)]
        parts += [(gdim - 1, facet_type, name, rows) for name, rows in groups.items()]
        for tag, (dim, element, name, rows) in enumerate(parts, start=1):
            if tag > 1:
                gmsh.model.addDiscreteEntity(dim, tag)
            gmsh.model.mesh.addElementsByType(tag, element, [], (rows + 1).ravel())
            gmsh.model.addPhysicalGroup(dim, [tag], tag)
            gmsh.model.setPhysicalName(dim, tag, name)
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(output))
    finally:
        gmsh.finalize()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", metavar="FILE", type=Path)
    parser.add_argument("--cell", choices=CELLS, default="hexahedron")
    parser.add_argument("--divisions", type=int, default=8, help="half of those of the radius")
    parser.add_argument("--radius", type=float, default=0.01, help="of the disc [m]")
    options = parser.parse_args()
    half_space(options.output, options.cell, options.divisions, options.radius)
