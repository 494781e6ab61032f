"""Make punch_*.msh: a piece of the half space z <= 0 around a disc of radius a (a strip in 2D).

    python meshes/half_space.py [--cell quadrilateral] [--divisions 8] [--output FILE]

Lengths are in metres. Only the quarter x >= 0, y >= 0 is meshed (in 2D the half x >= 0, with y in
place of z). The grid follows oblate spheroidal coordinates, in which the solution below a flat
punch is smooth: elements shrink with the square root towards the edge of the disc, where the
pressure is infinite, and grow with the distance from it, up to the far boundary.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from gmsh_files import CELLS, boundary_facets, brick, command_line, joined, write

FAR = 200.0  # distance of the far boundary, relative to the radius


def grid(gdim: int, divisions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions (n, gdim) and depths (n,) of the nodes, and cells as rows of nodes.

    The directions are points of the sphere octant on the three faces of a cube, which are divided
    by equal angles; the depths are the spheroids' numbers, from the disc (0) to the far boundary.
    """
    tangent = np.tan(np.linspace(0, np.pi / 4, divisions + 1))
    last = np.arccosh(FAR)
    depth = np.linspace(0, last, round(last / (np.pi / 4 / divisions)) + 1)
    parts = []
    for face in range(gdim):
        nodes, cells = brick([depth if axis == face else tangent for axis in range(gdim)])
        depths = nodes[:, face].copy()
        nodes[:, face] = 1.0
        directions = nodes / np.linalg.norm(nodes, axis=1, keepdims=True)
        parts.append((np.column_stack([directions, depths]), cells))
    columns, cells = joined(parts, 1.0)
    return columns[:, :-1], columns[:, -1], cells


def half_space(
    output: Path,
    cell: Literal["quadrilateral", "hexahedron"] = "hexahedron",
    divisions: int = 8,
    radius: float = 0.01,
) -> None:
    """Mesh it and write the file; twice as many `divisions` are on the radius [m]."""
    gdim, *_, sides = CELLS[cell]
    directions, depths, cells = grid(gdim, divisions)
    points = radius * directions * np.cosh(depths)[:, np.newaxis]
    points[:, -1] = -radius * directions[:, -1] * np.sinh(depths)
    facets = boundary_facets(cells, sides)

    def all_nodes(condition: np.ndarray) -> np.ndarray:
        return facets[condition[facets].all(axis=1)]

    groups = {
        "top": all_nodes((points[:, -1] == 0.0) & (np.cosh(depths) < 3)),
        "far": all_nodes(depths == depths.max()),
        "symmetry_x": all_nodes(directions[:, 0] == 0.0),
    }
    if gdim == 3:
        groups["symmetry_y"] = all_nodes(directions[:, 1] == 0.0)
    write(output, cell, points, {"half space": cells}, groups)


if __name__ == "__main__":
    command_line(half_space)
