"""Make hertz_*.msh: a half ball (half disc in 2D), or two that touch with their poles.

    python meshes/half_balls.py [--cell tetrahedron] [--radii 0.05 0.1] [--output FILE]

Lengths are in metres. Of each half ball only the quarter x >= 0, y >= 0 is meshed (of a half disc
the half x >= 0): the rest is its mirror image. The pole is at the origin, the flat cut face far
above it. Around the pole the mesh is uniform, from there on it coarsens, so that a small contact
area is resolved within a large body. In 2D, y takes the place of z.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import gmsh
import numpy as np
from gmsh_files import (
    CELLS,
    boundary_facets,
    brick,
    command_line,
    ignore_other_sizes,
    joined,
    session,
    set_size_formula,
    write,
)

PATCH = 5e-3  # the uniform part of the mesh reaches so far from the pole [m]
GROWTH = 1.25  # of neighbouring elements outside the patch


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

    points, cells = joined(blocks, size)
    antipole = far * np.eye(gdim)[-1]
    points[:, -1] *= -1
    points -= antipole
    points *= (far / np.linalg.norm(points, axis=1, keepdims=True)) ** 2
    return points + antipole, cells


def unstructured_half_ball(gdim: int, radius: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill the quarter of a half ball with tetrahedra, or triangles."""
    with session():
        occ, mesh = gmsh.model.occ, gmsh.model.mesh
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
        away = f"(sqrt(x^2+y^2+z^2)-{PATCH})"
        set_size_formula(f"{size}+{GROWTH - 1}*0.5*({away}+abs({away}))")
        ignore_other_sizes()
        mesh.generate(gdim)
        mesh.renumberNodes()
        _, coordinates, _ = mesh.getNodes()
        rows = mesh.getElements(gdim)[2][0].reshape(-1, gdim + 1).astype(np.int64) - 1
        points = coordinates.reshape(-1, 3)[:, :gdim]
    used, cells = np.unique(rows, return_inverse=True)
    return points[used], cells.reshape(rows.shape)


def boundary(
    points: np.ndarray, radius: float, cells: np.ndarray, sides: list[list[int]]
) -> dict[str, np.ndarray]:
    """Return the facets of the boundary in each group, as rows of nodes."""
    facets = boundary_facets(cells, sides)
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
    cell: Literal["triangle", "quadrilateral", "tetrahedron", "hexahedron"] = "hexahedron",
    element_size: float = 5e-4,
    radii: Sequence[float] = (0.05,),
) -> None:
    """Mesh a half ball above the plane z = 0 (y = 0 in 2D) and, given a second radius, one below.

    `element_size` [m] is that around the pole. Of equal radii, the two are mirror images. Of
    different ones, the grids of hexahedra still match near the pole, those of tetrahedra do not.
    """
    gdim, *_, sides = CELLS[cell]
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
    write(output, cell, np.concatenate(points), bodies, facets)


if __name__ == "__main__":
    command_line(half_balls)
