"""Make hertz_*.msh: a half ball (half disc in 2D), or two that touch with their poles.

    python meshes/half_balls.py FILE [--cell tetrahedron] [--element-size 5e-4] [--radii 0.05 0.1]

Needs Gmsh with its Python module ('apt install python3-gmsh' or 'pip install gmsh').
Lengths are in metres. Of each half ball only the quarter x >= 0, y >= 0 is meshed (of a half disc
the half x >= 0): the rest is its mirror image. The pole is at the origin, the flat cut face far
above it. Around the pole the mesh is uniform, from there on it coarsens, so that a small contact
area is resolved within a large body. In 2D, y takes the place of z.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import gmsh
import numpy as np

PATCH = 5e-3  # the uniform part of the mesh reaches so far from the pole [m]
GROWTH = 1.25  # of neighbouring elements outside the patch

# cell: dimension, Gmsh's number of the cell and of its facets, the nodes of its facets
CELLS = {
    "triangle": (2, 2, 1, [[0, 1], [1, 2], [2, 0]]),
    "quadrilateral": (2, 3, 1, [[0, 1], [1, 2], [2, 3], [3, 0]]),
    "tetrahedron": (3, 4, 2, [[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]]),
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


def brick(axes: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of a grid, and its cells as rows of nodes."""
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    number = np.arange(nodes[..., 0].size).reshape(nodes.shape[:-1])
    cells = [
        number[tuple(slice(s, n - 1 + s) for s, n in zip(corner, number.shape, strict=True))]
        for corner in CORNERS[len(axes)]
    ]
    return nodes.reshape(-1, len(axes)), np.stack(cells, axis=-1).reshape(-1, len(cells))


def structured_half_ball(gdim: int, radius: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut the quarter of a half ball into hexahedra, or quadrilaterals.

    First a half space is meshed up to the distance of 2 radii: a cube of equal elements at the
    origin, and around it shells that grow by a constant factor. The inversion in the sphere that
    touches the half space at the origin and has its centre at the antipole then makes a ball of the
    half space. It keeps all angles, and near the origin all lengths.
    """
    far = 2 * radius
    steps = np.linspace(0, 1, round(PATCH / size) + 1)
    shells = np.linspace(0, 1, int(np.ceil(np.log(far / PATCH) / np.log(GROWTH))) + 1)
    nodes, cells = brick([steps] * gdim)
    blocks = [(PATCH * nodes, cells)]
    for face in range(gdim):
        nodes, cells = brick([shells if axis == face else steps for axis in range(gdim)])
        shell = nodes[:, [face]].copy()
        nodes[:, face] = 1.0
        length = np.linalg.norm(nodes, axis=1, keepdims=True)
        start = PATCH * length
        blocks.append((nodes / length * start * (far / start) ** shell, cells))

    points = np.concatenate([nodes for nodes, _ in blocks])
    starts = np.cumsum([0] + [len(nodes) for nodes, _ in blocks[:-1]])
    cells = np.concatenate([rows + s for (_, rows), s in zip(blocks, starts, strict=True)])
    _, first, place = np.unique(
        np.round(points / size, 6), axis=0, return_index=True, return_inverse=True
    )
    points = points[first]
    antipole = far * np.eye(gdim)[-1]
    points[:, -1] *= -1
    points -= antipole
    points *= (far / np.linalg.norm(points, axis=1, keepdims=True)) ** 2
    return points + antipole, place.ravel()[cells]


def unstructured_half_ball(gdim: int, radius: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill the quarter of a half ball with tetrahedra, or triangles."""
    occ, mesh = gmsh.model.occ, gmsh.model.mesh
    gmsh.model.add("unstructured")
    if gdim == 3:
        ball = occ.addSphere(0, 0, radius, radius)
        # The poles and the seam of the parametrisation go where the quarter is not.
        occ.rotate([(3, ball)], 0, 0, radius, 1, 1, 0, -np.pi / 2)
        box = occ.addBox(0, 0, 0, radius, radius, radius)
    else:
        ball = occ.addDisk(0, radius, 0, radius, radius)
        box = occ.addRectangle(0, 0, 0, radius, radius)
    occ.intersect([(gdim, ball)], [(gdim, box)])
    occ.synchronize()
    field = mesh.field.add("MathEval")
    away = f"(sqrt(x^2+y^2+z^2)-{PATCH})"
    mesh.field.setString(field, "F", f"{size}+{GROWTH - 1}*0.5*({away}+abs({away}))")
    mesh.field.setAsBackgroundMesh(field)
    for option in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
        gmsh.option.setNumber(f"Mesh.{option}", 0)
    mesh.generate(gdim)
    mesh.renumberNodes()
    _, coordinates, _ = mesh.getNodes()
    rows = mesh.getElements(gdim)[2][0].reshape(-1, gdim + 1).astype(np.int64) - 1
    points = coordinates.reshape(-1, 3)[:, :gdim]
    gmsh.model.remove()
    used, cells = np.unique(rows, return_inverse=True)
    return points[used], cells.reshape(rows.shape)


def boundary(
    points: np.ndarray, radius: float, cells: np.ndarray, sides: list[list[int]]
) -> dict[str, np.ndarray]:
    """Return the facets of the boundary in each group, as rows of nodes."""
    facets = np.concatenate([cells[:, side] for side in sides])
    _, first, count = np.unique(
        np.sort(facets, axis=1), axis=0, return_index=True, return_counts=True
    )
    facets = facets[first[count == 1]]
    x, tiny = points[facets], 1e-9 * radius

    def all_nodes(condition: np.ndarray) -> np.ndarray:
        return facets[condition.all(axis=1)]

    on_sphere = np.abs(np.linalg.norm(x - radius * np.eye(x.shape[2])[-1], axis=2) - radius) < tiny
    near = np.linalg.norm(x[..., :-1], axis=2) < 1.5 * PATCH
    groups = {
        # somewhat more than what will touch
        "contact": all_nodes(on_sphere & near),
        "flat": all_nodes(np.abs(x[..., -1] - radius) < tiny),
        "symmetry_x": all_nodes(np.abs(x[..., 0]) < tiny),
    }
    if x.shape[2] == 3:
        groups["symmetry_y"] = all_nodes(np.abs(x[..., 1]) < tiny)
    return groups


def half_balls(
    output: Path,
    cell: str = "hexahedron",
    element_size: float = 5e-4,
    radii: Sequence[float] = (0.05,),
) -> None:
    """Mesh a half ball above the plane z = 0 (y = 0 in 2D) and, given a second radius, one below.

    Of equal radii, the two are mirror images. Of different ones, the grids of hexahedra still match
    near the pole, those of tetrahedra do not.
    """
    gdim, *types, sides = CELLS[cell]
    gmsh.initialize(readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        structured = cell in ("hexahedron", "quadrilateral")
        make = structured_half_ball if structured else unstructured_half_ball
        start, points = 0, []
        bodies: dict[str, np.ndarray] = {}
        groups: dict[str, list[np.ndarray]] = {}
        for name, sign, radius in zip(("upper", "lower"), (1, -1), radii, strict=False):
            nodes, cells = make(gdim, radius, element_size)
            nodes = np.round(nodes, 12)  # a picometre; shorter files
            for group, rows in boundary(nodes, radius, cells, sides).items():
                apart = len(radii) == 2 and group in ("contact", "flat")
                groups.setdefault(f"{group}_{name}" if apart else group, []).append(rows + start)
            nodes[:, -1] *= sign
            points.append(nodes)
            bodies[name] = cells + start
            start += len(nodes)
        facets = {name: np.concatenate(rows) for name, rows in sorted(groups.items())}
        write(output, np.concatenate(points), bodies, facets, types)
    finally:
        gmsh.finalize()


def write(
    output: Path,
    points: np.ndarray,
    bodies: dict[str, np.ndarray],
    groups: dict[str, np.ndarray],
    types: list[int],
) -> None:
    """Write cells and facets, both by name, as physical groups numbered 1, 2, ... in this order."""
    gdim = points.shape[1]
    gmsh.model.add("half_balls")
    gmsh.model.addDiscreteEntity(gdim)
    numbers = np.arange(1, len(points) + 1)
    gmsh.model.mesh.addNodes(gdim, 1, numbers, np.pad(points, ((0, 0), (0, 3 - gdim))).ravel())
    tag = 0
    for dim, element, named in ((gdim, types[0], bodies), (gdim - 1, types[1], groups)):
        for name, rows in named.items():
            tag += 1
            if (dim, tag) != (gdim, 1):
                gmsh.model.addDiscreteEntity(dim, tag)
            gmsh.model.mesh.addElementsByType(tag, element, [], (rows + 1).ravel())
            gmsh.model.addPhysicalGroup(dim, [tag], tag)
            gmsh.model.setPhysicalName(dim, tag, name)
    gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
    gmsh.write(str(output))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", choices=CELLS, default="hexahedron")
    parser.add_argument("--element-size", type=float, default=5e-4, help="around the pole [m]")
    parser.add_argument("--radii", type=float, nargs="+", default=[0.05], help="one or two [m]")
    parser.add_argument("output", type=Path)
    options = parser.parse_args()
    half_balls(options.output, options.cell, options.element_size, options.radii)
