"""The outer faces of deformed bodies with fields on them, as data for pictures and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.io.fields import field_degree, raised_to_degree
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_facets, cell_type, exterior_cell_facets, owned_cells
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector


@dataclass(frozen=True)
class Scene:
    """Outer faces, or the cells in two dimensions; those of degree 2 cut at their nodes.

    For a section they are the cells in space, of dolfinx's order of vertices, with straight edges.
    """

    points: Vector  # (n, 3) [m]
    displacement: Vector  # (n, 3) [m]
    faces: Numbers  # (m, 3 or 4) corners, counterclockwise from outside; (m, 4 or 8) of cells
    fields: dict[str, Vector]  # by name: of nodes (n,), or of faces (m, 1)
    flat: bool  # a mesh of two dimensions

    @property
    def scale(self) -> float:
        """1, 2 or 5 times a power of ten; with it displacements are a tenth of the mesh at most.

        Displacements that are larger are drawn as they are.
        """
        largest = float(np.linalg.norm(self.displacement, axis=1).max())
        size = float(np.ptp(self.points, axis=0).max())
        if largest == 0.0:
            return 1.0
        target = max(0.1 * size / largest, 1.0)
        power = 10.0 ** np.floor(np.log10(target))
        return float(power * max(k for k in (1, 2, 5) if k * power <= target * (1 + 1e-9)))

    def triangulated(self) -> Scene:
        """Return the scene with each quadrilateral cut in two triangles."""
        if self.faces.shape[1] == 3:
            return self
        halves = self.faces[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
        fields = {
            name: values if values.ndim == 1 else np.repeat(values, 2, axis=0)
            for name, values in self.fields.items()
        }
        return replace(self, faces=halves, fields=fields)


def gather_scene(
    displacement: Function,
    fields: Sequence[Function] = (),
    cells: Numbers | None = None,
    solid: bool = False,
) -> Scene | None:
    """Gather the outer faces on rank 0; the other ranks get None. Collective.

    The displacement is continuous of degree 1 or 2, fields are scalars, continuous or constant on
    each cell; what is wrong of them raises an `InputError` on all ranks. The first field of the
    scene is the size of the displacement. `cells` are local numbers of those whose faces are
    gathered, all by default; with `solid` the cells themselves are.
    """
    mesh = displacement.function_space.mesh
    with raise_collectively(mesh.comm):
        _check_displacement(displacement)
        for field in fields:
            _check_colour(displacement, field)
    drawn = np.ones(owned_cells(mesh), dtype=bool)
    if cells is not None:
        drawn[:] = False
        drawn[cells[cells < drawn.size]] = True
    raised, dofs = list(fields), partial(_corner_dofs, drawn=drawn)
    if not solid:
        degree = max(_compat.geometry_degree(mesh), *map(field_degree, (displacement, *fields)), 1)
        displacement, *raised = (
            raised_to_degree(field, degree) for field in (displacement, *fields)
        )
        dofs = partial(_face_dofs, drawn=drawn)
    nodes, place = NodeMap(displacement.function_space), dofs(displacement.function_space)
    columns = [
        nodes.to_global(place),
        nodes.space.tabulate_dof_coordinates()[place],
        nodes.values(displacement)[place],
        *(field.x.array[dofs(field.function_space)] for field in raised),
    ]
    ranks = mesh.comm.gather(columns)
    if ranks is None:
        return None
    numbers, x, u, *colours = (np.concatenate(parts) for parts in zip(*ranks, strict=True))
    _, first, row = np.unique(numbers, return_index=True, return_inverse=True)
    gdim = mesh.geometry.dim
    points, moves = x.reshape(-1, 3)[first], u.reshape(-1, gdim)[first]
    faces, per_face = row.reshape(numbers.shape), 1
    if not solid:
        facets = Facets(points, faces)
        faces, per_face = facets.pieces, facets.per_facet
    if gdim == 2:
        a, b, c = np.moveaxis(points[faces[:, :3]], 1, 0)
        clockwise = np.cross(b - a, c - a)[:, 2] < 0.0
        faces = np.where(clockwise[:, None], faces[:, ::-1], faces)
    values = {"displacement": np.linalg.norm(moves, axis=1)}
    for field, rows in zip(fields, colours, strict=True):
        by_face = rows.shape[1] == 1
        values[field.name] = np.repeat(rows, per_face, axis=0) if by_face else rows.ravel()[first]
    return Scene(points, np.pad(moves, ((0, 0), (0, 3 - gdim))), faces, values, gdim == 2)


def _corner_dofs(space: FunctionSpace, drawn: Mask) -> Indices:
    """Return the local nodes of a space at the vertices of cells, or the one of a constant."""
    degree, dofs = _compat.element_facts(space)[1], _compat.cell_dofs(space)
    return dofs[: drawn.size][drawn][:, : cell_type(space.mesh).vertices if degree else 1]


def _face_dofs(space: FunctionSpace, drawn: Mask) -> Indices:
    """Return the local nodes (f, t) of a space around the faces of drawn cells, as `Facets`.

    Faces are those without a neighbour, or the cells in two dimensions. Constants on cells have one
    node in each.
    """
    mesh, degree = space.mesh, _compat.element_facts(space)[1]
    if mesh.topology.dim == 2:
        cells = _compat.cell_dofs(space)[: drawn.size][drawn]
        return cells if degree == 0 else cells[:, cell_type(mesh).around(degree)]
    cell, facet = np.nonzero(exterior_cell_facets(mesh) & drawn[:, None])
    if degree == 0:
        return _compat.cell_dofs(space)[cell]
    return oriented_facets(space, cell_facets(mesh)[cell, facet])


def _check_displacement(displacement: Function) -> None:
    mesh = displacement.function_space.mesh
    _, _, shape = _compat.element_facts(displacement.function_space)
    if field_degree(displacement) == 0 or shape != (mesh.geometry.dim,):
        raise InputError(
            f"'{displacement.name}' is not a displacement; a continuous field of degree 1 or 2 "
            f"with {mesh.geometry.dim} components is expected"
        )
    _check_finite(displacement)


def _check_colour(displacement: Function, colour: Function) -> None:
    _, _, shape = _compat.element_facts(colour.function_space)
    field_degree(colour)
    if shape != ():
        raise InputError(f"the colour '{colour.name}' has shape {shape}; a scalar is expected")
    if colour.function_space.mesh is not displacement.function_space.mesh:
        raise InputError(f"'{colour.name}' is on another mesh than '{displacement.name}'")
    _check_finite(colour)


def _check_finite(function: Function) -> None:
    if not np.all(np.isfinite(function.x.array)):
        raise InputError(f"'{function.name}' has values that are NaN or infinite")
