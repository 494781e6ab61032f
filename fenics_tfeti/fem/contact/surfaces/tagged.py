"""Tagged surfaces: the nodes that this rank owns, with normals, areas and sizes of facets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import Constant, Function, FunctionSpace
from dolfinx.mesh import Mesh
from ufl.algorithms import extract_arguments
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_domains

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.mortar.facets import Facets
from fenics_tfeti.fem.contact.surfaces.faceted import edge_lengths
from fenics_tfeti.fem.contact.surfaces.oriented import corner_normals, oriented_facets, owned_facets
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.messages import coordinate_order, first_wrong
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, RELATIVE_ROUNDING, VANISHING_NORMAL
from fenics_tfeti.fem.topology import (
    cell_facets,
    cell_type,
    cell_vertices,
    exterior_facets,
    vertex_nodes,
)
from fenics_tfeti.fem.user_data import VectorField, unit_vectors
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

Array = NDArray[Any]


@dataclass(frozen=True)
class MeshBoundary:
    """Data of the boundary of a mesh that all its tagged surfaces share."""

    space: FunctionSpace  # that of the displacement
    nodes: NodeMap  # its nodes
    coordinates: Vector  # (nodes, 3): of this rank's nodes, ghosts last [m]
    # whether each facet of this rank is on the boundary; False for ghosts
    exterior: NDArray[np.bool_]
    weight: Any  # factor of ds in the forms, an expression of UFL; None without one

    @staticmethod
    def of(space: FunctionSpace, measure_weight: Any = None) -> MeshBoundary:
        """Find the boundary of a space's mesh. Collective."""
        domain, coordinates = space.mesh, space.tabulate_dof_coordinates()
        with raise_collectively(domain.comm):
            weight = as_ufl_weight(domain, measure_weight)
        exterior = exterior_facets(domain)
        cells = np.flatnonzero(exterior[cell_facets(domain)].any(axis=1))
        # dolfinx maps the nodes from the reference cell, with rounding
        vertices = domain.geometry.x[cell_vertices(domain)[cells]]
        coordinates[vertex_nodes(space)[cells]] = vertices
        return MeshBoundary(space, NodeMap(space), coordinates, exterior, weight)

    @property
    def degree(self) -> int:
        """Degree of the displacement, 1 or 2."""
        return _compat.element_facts(self.space)[1]

    def nodal_weight(self) -> Vector | None:
        """Evaluate the weight at all local nodes at vertices; None without one. Collective."""
        if self.weight is None:
            return None
        scalar = Function(_compat.lagrange_space(self.space.mesh, 1))
        _compat.interpolate_expression(self.weight, scalar)
        scalar.x.scatter_forward()
        values = np.zeros(self.nodes.size)
        # the two spaces may number their nodes differently
        values[vertex_nodes(self.space)] = scalar.x.array[vertex_nodes(scalar.function_space)]
        return values


@dataclass(frozen=True)
class Surface:
    """A tagged surface; of the nodes at its vertices, those that this rank owns."""

    boundary: MeshBoundary
    nodes: Numbers  # global nodes of the displacement's space at the vertices of facets (k,)
    normal: Vector  # outward unit normals (k, gdim)
    area: Vector  # (k,): turns a uniform pressure into the normal force, without weight [m^2 or m]
    size: Vector  # (k,): mean edge length of the smallest of the facets at the node [m]
    facet_nodes: Indices  # (f, t): local nodes of the facets that it owns; see `oriented_facets`
    extent: float  # largest coordinate of the surface by magnitude, over all ranks [m]

    @property
    def comm(self) -> MPI.Intracomm:
        """The ranks."""
        comm: MPI.Intracomm = self.boundary.nodes.comm
        return comm

    @cached_property
    def local(self) -> Numbers:
        """Local numbers of the nodes (k,)."""
        local: Numbers = self.nodes - self.boundary.nodes.first
        return local

    @cached_property
    def coordinates(self) -> Vector:
        """Coordinates of shape (k, 3) [m]."""
        return self.boundary.coordinates[self.local]

    @property
    def points(self) -> Vector:
        """Coordinates of shape (k, gdim) [m]."""
        return self.coordinates[:, : self.normal.shape[1]]

    @cached_property
    def vertices(self) -> Indices:
        """Local numbers of the nodes (f, v) at the facets' corners, one after the other."""
        return self.facet_nodes[:, : cell_type(self.boundary.space.mesh).facet.vertices]

    @cached_property
    def corners(self) -> Vector:
        """The places (f, v, gdim) of the facets' corners [m]."""
        return self.boundary.coordinates[self.vertices, : self.normal.shape[1]]

    def without_rounding(self, lengths: Vector) -> Vector:
        """Set lengths [m] to zero that are no more than the rounding of coordinates."""
        return np.where(np.abs(lengths) <= COORDINATE_ROUNDING * self.extent, 0.0, lengths)

    def at_corners(self, values: Array) -> Array:
        """Return values (k, ...) at owned nodes at the facets' corners (f, v, ...). Collective."""
        nodes = self.boundary.nodes
        table = np.zeros((nodes.owned, *values.shape[1:]), dtype=values.dtype)
        table[self.local] = values
        return nodes.values_at(table, nodes.to_global(self.vertices))

    def sum_of_corners(self, values: Array, ufunc: Any = np.add) -> Array:
        """Sum values (f, v, ...) at corners of facets at their owned nodes (k, ...). Collective."""
        nodes, vertices = self.boundary.nodes, self.vertices
        flat = values.reshape(vertices.size, *values.shape[2:])
        sums = nodes.sum_at_owners(nodes.to_global(vertices.ravel()), flat, ufunc)
        found: Array = sums[self.local]
        return found

    def max_of_facets(self, values: Vector) -> Vector:
        """Return the largest value (k,) of the facets (f,) around each node, or 0. Collective."""
        at_corners = np.repeat(values[:, None], self.vertices.shape[1], axis=1)
        return self.sum_of_corners(at_corners, np.maximum)

    def share_of_area(self, chosen: Mask, weight: Vector | None = None) -> Vector:
        """Return the share (k,) of each node's area that belongs to chosen facets (f,). Collective.

        The weight (nodes,) of the measure is at this rank's nodes; by default there is none.
        """
        x = self.boundary.coordinates[self.facet_nodes, : self.normal.shape[1]]
        at_corners = None if weight is None else weight[self.vertices]
        integrals = corner_normals(x, at_corners) * chosen[:, None, None]
        area: Vector = np.sum(self.sum_of_corners(integrals) * self.normal, axis=1)
        return area

    def check_weight(self, weighted: Vector, rows: Numbers | slice, name: str) -> None:
        """Check that areas (k,) with the weight of the measure, at some nodes, are positive."""
        mean, points = weighted / self.area[rows], self.points[rows]
        if bad := first_wrong(self.comm, ~np.isfinite(mean), points):
            raise InputError(
                f"slave of {name}: measure_weight is NaN or infinite around {bad.number} nodes, "
                f"the first at {bad.place}"
            )
        largest = self.comm.allreduce(float(np.abs(mean).max(initial=0.0)), MPI.MAX)
        if bad := first_wrong(self.comm, mean <= RELATIVE_ROUNDING * largest, points):
            raise InputError(
                f"slave of {name}: measure_weight is negative or zero around {bad.number} nodes, "
                f"the first at {bad.place}: as the factor of ds it has to be positive there. Has "
                "the mesh nodes of negative radius, or is a surface on the axis tagged?"
            )

    def areas(self, covered: Mask, name: str) -> Vector:
        """Return each node's area on covered facets, or all of it where it has none. Collective.

        The areas are (k,) [m^2 or m], times the weight of the measure; `covered` (f,) are the
        facets of this rank that count.
        """
        area, weight = self.area, self.boundary.nodal_weight()
        if weight is not None:
            area = self.share_of_area(np.ones_like(covered), weight)
            self.check_weight(area, slice(None), name)
        if self.comm.allreduce(bool(covered.all()), MPI.LAND):
            return area
        covered_area = self.share_of_area(covered, weight)
        return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)

    def part(
        self, displacement: Function | None = None, chosen: Numbers | slice = slice(None)
    ) -> SurfaceFacets:
        """Return the facets of this rank, or some of them, deformed by a displacement [m] if given.

        The ghosts of the displacement are up to date.
        """
        boundary, rows = self.boundary, self.facet_nodes[chosen]
        nodes, first, inverse = np.unique(
            boundary.nodes.to_global(rows), return_index=True, return_inverse=True
        )
        local = rows.ravel()[first]
        points = boundary.coordinates[local, : self.normal.shape[1]]
        moves = np.zeros_like(points)
        if displacement is not None:
            moves = boundary.nodes.values(displacement)[local]
        return SurfaceFacets(nodes, Facets(points + moves, inverse.reshape(rows.shape)), moves)

    def oriented_part(self, displacement: Function | None = None) -> SurfaceFacets:
        """Return the facets of this rank with the surface's normals and the weight. Collective."""
        nodes, part = self.boundary.nodes, self.part(displacement)
        normal = np.zeros((nodes.owned, self.normal.shape[1]))
        normal[self.local] = self.normal
        weight = self.boundary.nodal_weight()
        return replace(
            part,
            vertex_normals=nodes.values_at(normal, part.nodes),
            weight=None if weight is None else weight[nodes.to_local(part.nodes)],
        )

    def gathered(self, displacement: Function | None = None) -> SurfaceFacets:
        """Return the facets of all ranks, deformed by a displacement [m] if given. Collective."""
        return SurfaceFacets.joined(self.comm.allgather(self.part(displacement)))

    def gathered_nodes(self) -> SurfaceNodes:
        """Return the nodes of all ranks in the order of their coordinates. Collective."""
        columns = (self.nodes, self.points, self.normal, self.size)
        nodes, points, normal, size = (concatenate_ranks(self.comm, column) for column in columns)
        # of equally near nodes, the same is then chosen however the mesh is distributed
        order = coordinate_order(points)
        return SurfaceNodes(nodes[order], points[order], normal[order], size[order])


@dataclass(frozen=True)
class SurfaceNodes:
    """All nodes of a surface, on every rank and in one order for any number of ranks."""

    nodes: Numbers  # global nodes (m,)
    points: Vector  # (m, gdim) [m]
    normal: Vector  # outward unit normals (m, gdim)
    size: Vector  # (m,): mean edge length of the smallest of the facets at the node [m]

    def without(self, nodes: Numbers) -> SurfaceNodes:
        """Leave out some nodes."""
        kept = ~np.isin(self.nodes, nodes)
        return SurfaceNodes(self.nodes[kept], self.points[kept], self.normal[kept], self.size[kept])


def tagged_surface(
    boundary: MeshBoundary,
    facet_tags: Any,
    tag: int,
    label: str,
    user_normal: VectorField | None = None,
) -> Surface:
    """Find the nodes of a tagged surface, this rank's part. Collective.

    `label` is its name in messages. By default normals are area-weighted averages of the facets'.
    """
    space, nodes = boundary.space, boundary.nodes
    domain = space.mesh
    comm, gdim = domain.comm, domain.geometry.dim
    with raise_collectively(comm):
        _check_tags(domain, facet_tags, label)
    facets = owned_facets(domain, facet_tags, tag)
    facet_nodes = oriented_facets(space, facets)
    x = boundary.coordinates[facet_nodes, :gdim]
    vertices = facet_nodes[:, : cell_type(domain).facet.vertices]
    corners = x[:, : vertices.shape[1]]
    _check_facets(boundary, facet_tags, tag, facets, corners.mean(axis=1), label)
    numbers = nodes.to_global(vertices.ravel())
    local = np.unique(nodes.to_owners(numbers)[0])
    coordinates = boundary.coordinates[local]
    extent = comm.allreduce(float(np.abs(coordinates).max(initial=0.0)), MPI.MAX)
    weighted = corner_normals(x)
    sizes = np.linalg.norm(weighted, axis=2, keepdims=True)
    integrals = np.concatenate([weighted, sizes], axis=2).reshape(-1, gdim + 1)
    sums = nodes.sum_at_owners(numbers, integrals)[local]
    # of a segment both edges are the segment
    edges = edge_lengths(corners).mean(axis=1)
    size = nodes.sum_at_owners(numbers, np.repeat(edges, vertices.shape[1]), np.minimum)[local]
    normal, area = _normals_and_areas(
        comm, sums[:, :gdim], sums[:, gdim], coordinates, user_normal, label
    )
    return Surface(boundary, local + nodes.first, normal, area, size, facet_nodes, extent)


def _check_tags(domain: Any, facet_tags: Any, label: str) -> None:
    if not _compat.tags_are_on(facet_tags, domain):
        raise InputError(f"{label}: facet_tags belong to another mesh than the displacement")
    dim = domain.topology.dim
    if facet_tags.dim != dim - 1:
        raise InputError(
            f"{label}: facet_tags are on entities of dimension {facet_tags.dim}, facets have "
            f"dimension {dim - 1}"
        )


def _check_facets(
    boundary: MeshBoundary, facet_tags: Any, tag: int, facets: Indices, middles: Vector, label: str
) -> None:
    comm = boundary.space.mesh.comm
    number = comm.allreduce(facets.size)
    if number == 0:
        existing = np.unique(concatenate_ranks(comm, np.unique(facet_tags.values))).tolist()
        raise InputError(f"{label}: tag {tag} is on no facet; the tags there are {existing}")
    if bad := first_wrong(comm, ~boundary.exterior[facets], middles):
        raise InputError(
            f"{label}: {bad.number} of the {number} facets with tag {tag} are inside a body, or "
            f"between bodies that share their nodes, the first around {bad.place}: only facets on "
            "the boundary can touch. Bodies that share nodes, as Gmsh's fragment makes them, get "
            "nodes of their own by fenics_tfeti.io.split_interfaces"
        )


def _normals_and_areas(
    comm: MPI.Intracomm,
    weighted: Vector,
    facet_area: Vector,
    coordinates: Vector,
    user_normal: VectorField | None,
    label: str,
) -> tuple[Vector, Vector]:
    """Return unit normals and areas (k,) from integrals of the normal and of its length."""
    gdim = weighted.shape[1]
    length = np.linalg.norm(weighted, axis=1)
    minimum = VANISHING_NORMAL * facet_area
    if user_normal is None:
        if bad := first_wrong(comm, length <= minimum, coordinates[:, :gdim]):
            raise InputError(
                f"{label}: the normals of the facets around {bad.number} nodes cancel, the first "
                f"at {bad.place}: tag one side of an edge only, or give a normal"
            )
        return weighted / length[:, None], length
    normal = unit_vectors(comm, user_normal, coordinates, gdim, f"the normal of the {label}")
    area = np.sum(weighted * normal, axis=1)
    if bad := first_wrong(comm, area <= minimum, coordinates[:, :gdim]):
        raise InputError(
            f"the normal of the {label} points into the body or along its surface at {bad.number} "
            f"nodes, the first at {bad.place}: it has to point out of the slave, as the facets' do"
        )
    return normal, area


def as_ufl_weight(domain: Mesh, weight: Any) -> Any:
    """Return the weight of the measure as an expression of UFL, checked; None for none."""
    if weight is None:
        return None
    if isinstance(weight, int | float | np.number) and not isinstance(weight, bool):
        # a Constant: for each number in the expression, code would be compiled anew
        return Constant(domain, float(weight))
    if not isinstance(weight, Expr):
        raise InputError(
            f"measure_weight is a {type(weight).__name__}; a scalar expression of UFL or a number "
            "is expected, such as 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]"
        )
    if weight.ufl_shape or weight.ufl_free_indices:
        raise InputError(
            f"measure_weight has shape {weight.ufl_shape}; a scalar is expected, by which ds is "
            "multiplied in the forms"
        )
    if extract_arguments(weight):
        raise InputError(
            "measure_weight contains a test or trial function; give the factor of ds in the forms "
            "alone"
        )
    mesh_domain = domain.ufl_domain()
    for terminal in traverse_unique_terminals(weight):
        if any(part != mesh_domain for part in extract_domains(terminal)):
            raise InputError("measure_weight is on another mesh than the displacement")
    return weight
