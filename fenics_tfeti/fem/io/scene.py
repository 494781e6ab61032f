"""The outer faces of deformed bodies with fields on them, as data for a viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.io.pictures import (
    GatheredMesh,
    check_colour,
    check_displacement,
    gather_mesh,
    round_scale,
)
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector

# outward faces of VTK's cells by their number: triangle, quadrilateral, tetrahedron, hexahedron
_FACES = {
    5: ((0, 1, 2),),
    9: ((0, 1, 2, 3),),
    10: ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    12: (
        *((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4)),
        *((1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    ),
}


@dataclass(frozen=True)
class Scene:
    """Triangles of the outer faces, or of the cells in two dimensions."""

    points: Vector  # (n, 3) [m]
    displacement: Vector  # (n, 3) [m]
    triangles: Numbers  # (t, 3) corners, counterclockwise from outside
    fields: dict[str, Vector]  # (n,) or (t,) by name
    scale: float  # magnification that makes displacements visible
    flat: bool  # a mesh of two dimensions


def gather_scene(displacement: Function, fields: Sequence[Function] = ()) -> Scene | None:
    """Gather the outer faces on rank 0; the other ranks get None. Collective.

    The displacement is continuous of degree 1 or 2, fields are scalars, continuous or constant on
    each cell; what is wrong of them raises an `InputError` on all ranks.
    """
    with raise_collectively(displacement.function_space.mesh.comm):
        check_displacement(displacement)
        for field in fields:
            check_colour(displacement, field)
    views = [gather_mesh(displacement, field) for field in (None, *fields)]
    view = views[0]
    if view is None:
        return None
    names = ["displacement", *(field.name for field in fields)]
    triangles, cell = outer_triangles(view)
    kept, corners = np.unique(triangles, return_inverse=True)
    values: dict[str, Vector] = {}
    for name, gathered in zip(names, views, strict=True):
        if gathered is not None:
            by_cell = len(gathered.colours) == len(gathered.cells)
            values[name] = gathered.colours[cell] if by_cell else gathered.colours[kept]
    flat = displacement.function_space.mesh.geometry.dim == 2
    moves = view.displacement[kept]
    return Scene(view.points[kept], moves, corners.reshape(-1, 3), values, round_scale(view), flat)


def outer_triangles(mesh: GatheredMesh) -> tuple[Numbers, Numbers]:
    """Return the triangles of the faces of one cell only, and the cell of each."""
    table = np.array(_FACES[mesh.vtk_type])
    faces = mesh.cells[:, table].reshape(-1, table.shape[1])
    cell = np.repeat(np.arange(len(mesh.cells)), len(table))
    if len(table) > 1:
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        outer = np.sort(first[count == 1])
        faces, cell = faces[outer], cell[outer]
    if faces.shape[1] == 3:
        return faces, cell
    halves = faces[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return halves, np.repeat(cell, 2)
