"""Tagged surfaces: the nodes that this rank owns, with normals, areas and sizes of facets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

import ufl
from dolfinx import fem
from dolfinx.fem import FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.oriented import (
    corner_normals,
    oriented_facets,
    owned_facets,
)
from fenics_tfeti.fem.messages import coordinate_order, raise_where
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.reference_cells import ReferenceCell
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, VANISHING_NORMAL
from fenics_tfeti.fem.topology import (
    cell_facets,
    cell_type,
    cell_vertices,
    exterior_facets,
    vertex_nodes,
)
from fenics_tfeti.fem.user_data import unit_vectors
from fenics_tfeti.parallel import Directory, concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Indices, Numbers, Vector

VectorField = ArrayLike | Callable[[Vector], ArrayLike]


@dataclass(frozen=True)
class MeshBoundary:
    """Data of the boundary of a mesh that all its tagged surfaces share."""

    space: FunctionSpace  # that of the displacement
    nodes: NodeMap  # its nodes
    linear: FunctionSpace  # of degree 1 on its mesh, which it may be itself
    coordinates: Vector  # (nodes, 3): of this rank's nodes, ghosts last [m]
    is_vertex: NDArray[np.bool_]  # (nodes,): whether a node is a vertex of cells
    # whether each facet of this rank is on the boundary; False for ghosts
    exterior: NDArray[np.bool_]
    rows: Indices  # (facets, 2): a cell of each facet of this rank, and the facet's number in it
    normal_form: _compat.CompiledForm  # the normal times each vertex' shape function of degree 1

    @staticmethod
    def of(space: FunctionSpace) -> MeshBoundary:
        """Find the boundary of a space's mesh. Collective."""
        domain = space.mesh
        exterior = exterior_facets(domain)
        facet_of = cell_facets(domain)
        rows = np.zeros((exterior.size, 2), dtype=np.int32)
        rows[facet_of, 0] = np.arange(len(facet_of))[:, None]
        rows[facet_of, 1] = np.arange(facet_of.shape[1])
        linear = space
        if _compat.element_facts(space)[1] > 1:
            linear = _compat.lagrange_space(domain, 1, space.dofmap.index_map_bs)
        coordinates = space.tabulate_dof_coordinates()
        is_vertex = np.zeros(len(coordinates), dtype=bool)
        is_vertex[vertex_nodes(space)] = True
        form = _normal_form(linear)
        return MeshBoundary(
            space, NodeMap(space), linear, coordinates, is_vertex, exterior, rows, form
        )

    @property
    def degree(self) -> int:
        """Degree of the displacement, 1 or 2."""
        return 1 if self.linear is self.space else 2

    def form_with_weight(self, weight: Any) -> _compat.CompiledForm:
        """Compile `normal_form` with a weight of ds. Collective."""
        return _normal_form(self.linear, weight)

    def integrate(self, form: _compat.CompiledForm, facets: Indices) -> Vector:
        """Integrate the normal times each vertex' shape function over facets: (nodes, gdim).

        The shape functions are those of degree 1. The length of the integral is the area that turns
        a uniform pressure into the force of the vertex. It is zero at other nodes.
        """
        bound = form.bind([self.linear], {}, {1: self.rows[facets]})
        values = _compat.assemble_distributed(bound).reshape(-1, self.space.dofmap.index_map_bs)
        if self.degree == 1:
            return values
        integrals = np.zeros((len(self.coordinates), values.shape[1]))
        nodes, linear_nodes = vertex_nodes(self.space), vertex_nodes(self.linear)
        # both spaces' nodes at a vertex have the owner of the vertex
        owned = linear_nodes < len(values)
        integrals[nodes[owned]] = values[linear_nodes[owned]]
        return integrals


def _normal_form(space: FunctionSpace, weight: Any = 1) -> _compat.CompiledForm:
    """Compile the normal times each vertex' shape function and a weight. Collective."""
    domain = space.mesh
    normal = ufl.inner(ufl.FacetNormal(domain), ufl.TestFunction(space))
    ds = ufl.Measure("ds", domain=domain)
    return _compat.CompiledForm(weight * normal * ds(1), domain.comm)


@dataclass(frozen=True)
class Surface:
    """A tagged surface; of the nodes at its vertices, those that this rank owns."""

    nodes: Numbers  # global nodes of the displacement's space at the vertices of facets (k,)
    local: Indices  # their local numbers (k,)
    coordinates: Vector  # (k, 3) [m]
    normal: Vector  # outward unit normals (k, gdim)
    area: Vector  # (k,): turns a uniform pressure into the normal force, without weight [m^2 or m]
    size: Vector  # (k,): mean edge length of the smallest of the facets at the node [m]
    facets: Indices  # facets that this rank owns (f,)
    facet_nodes: Indices  # (f, t): their local nodes, also of other ranks; see `oriented_facets`
    facet_type: ReferenceCell
    extent: float  # largest coordinate of the surface by magnitude, over all ranks [m]

    @property
    def vertices(self) -> Indices:
        """Local numbers of the nodes (f, v) at the facets' corners, one after the other."""
        return self.facet_nodes[:, : self.facet_type.vertices]

    @property
    def points(self) -> Vector:
        """Coordinates of shape (k, gdim) [m]."""
        return self.coordinates[:, : self.normal.shape[1]]

    def without_rounding(self, lengths: Vector) -> Vector:
        """Set lengths [m] to zero that are no more than the rounding of coordinates."""
        return np.where(np.abs(lengths) <= COORDINATE_ROUNDING * self.extent, 0.0, lengths)


@dataclass(frozen=True)
class MasterNodes:
    """All nodes of a master's surface, on every rank and in one order for any number of ranks."""

    nodes: Numbers  # global nodes (m,)
    points: Vector  # (m, gdim) [m]
    normal: Vector  # outward unit normals (m, gdim)
    size: Vector  # (m,): mean edge length of the smallest of the facets at the node [m]

    def without(self, nodes: Numbers) -> MasterNodes:
        """Leave out some nodes."""
        kept = ~np.isin(self.nodes, nodes)
        return MasterNodes(self.nodes[kept], self.points[kept], self.normal[kept], self.size[kept])


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
    space = boundary.space
    domain, dim = space.mesh, space.mesh.topology.dim
    with raise_collectively(domain.comm):
        _check_tags(domain, facet_tags, label)
    facets = owned_facets(domain, facet_tags, tag)
    _check_facets(boundary, facet_tags, tag, facets, label)

    nodes = np.asarray(fem.locate_dofs_topological(space, dim - 1, facets), dtype=np.int32)
    nodes = np.sort(nodes[(nodes < boundary.nodes.owned) & boundary.is_vertex[nodes]])
    coordinates = boundary.coordinates[nodes]
    extent = domain.comm.allreduce(float(np.abs(coordinates).max(initial=0.0)), MPI.MAX)
    weighted = boundary.integrate(boundary.normal_form, facets)[nodes]
    facet_nodes, facet_type = oriented_facets(space, facets), cell_type(domain).facet
    vertices = facet_nodes[:, : facet_type.vertices]
    numbers = NodeMap(space).to_global(nodes)
    corners = boundary.coordinates[vertices, : domain.geometry.dim]
    size, facet_area = _facets_at_nodes(
        domain.comm, corners, NodeMap(space).to_global(vertices), numbers
    )
    normal, area = _normals_and_areas(
        domain.comm, weighted, facet_area, coordinates, user_normal, label
    )
    return Surface(
        numbers,
        nodes,
        coordinates,
        normal,
        area,
        size,
        facets,
        facet_nodes,
        facet_type,
        extent,
    )


def gather_master(comm: MPI.Intracomm, master: Surface) -> MasterNodes:
    """Gather a surface's nodes on every rank, in the order of their coordinates."""
    columns = (master.nodes, master.points, master.normal, master.size)
    nodes, points, normal, size = (concatenate_ranks(comm, column) for column in columns)
    # of equally near nodes, the same is then chosen however the mesh is distributed
    order = coordinate_order(points)
    return MasterNodes(nodes[order], points[order], normal[order], size[order])


def values_on_facets(space: FunctionSpace, surface: Surface, values: Vector) -> Vector:
    """Return vectors (f, v, gdim) at the corners of this rank's facets. Collective.

    The values (k, gdim) are those at the nodes that this rank owns.
    """
    gdim = values.shape[1]
    carrier = fem.Function(space)
    carrier.x.array.reshape(-1, gdim)[surface.local] = values
    carrier.x.scatter_forward()
    corner_values: Vector = carrier.x.array.reshape(-1, gdim)[surface.vertices]
    return corner_values


def facet_max_at_nodes(space: FunctionSpace, surface: Surface, values: Vector) -> Vector:
    """Return at the nodes (k,) that this rank owns the largest value of their facets. Collective.

    The values (f,) of this rank's facets are not negative.
    """
    vertices = NodeMap(space).to_global(surface.vertices.ravel())
    owners = Directory(space.mesh.comm, surface.nodes)
    keys, values = owners.forward(vertices, np.repeat(values, surface.vertices.shape[1]))
    largest = np.zeros(surface.nodes.size)
    np.maximum.at(largest, np.searchsorted(surface.nodes, keys), values)
    return largest


def area_of_facets(
    boundary: MeshBoundary,
    surface: Surface,
    chosen: NDArray[np.bool_],
    form: _compat.CompiledForm | None = None,
) -> Vector:
    """Return the share (k,) of each node's area that belongs to chosen facets (f,). Collective.

    The form is that of `MeshBoundary.form_with_weight`; by default there is no weight.
    """
    facets = surface.facets[chosen]
    weighted = boundary.integrate(form or boundary.normal_form, facets)[surface.local]
    area: Vector = np.sum(weighted * surface.normal, axis=1)
    return area


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
    boundary: MeshBoundary, facet_tags: Any, tag: int, facets: Indices, label: str
) -> None:
    comm = boundary.space.mesh.comm
    number = comm.allreduce(facets.size)
    if number == 0:
        existing = np.unique(concatenate_ranks(comm, np.unique(facet_tags.values))).tolist()
        raise InputError(f"{label}: tag {tag} is on no facet; the tags there are {existing}")
    domain = boundary.space.mesh
    cell, facet = boundary.rows[facets].T
    corners = np.array(cell_type(domain).facets)[facet]
    vertices = np.take_along_axis(cell_vertices(domain)[cell], corners, axis=1)
    raise_where(
        comm,
        ~boundary.exterior[facets],
        domain.geometry.x[vertices, : domain.geometry.dim].mean(axis=1),
        lambda interior, place: (
            f"{label}: {interior} of the {number} facets with tag {tag} are inside a body, or "
            f"between bodies that share their nodes, the first around {place}: only facets on the "
            "boundary can touch. Bodies that share nodes, as Gmsh's fragment makes them, get nodes "
            "of their own by fenics_tfeti.io.split_interfaces"
        ),
    )


def _normals_and_areas(
    comm: MPI.Intracomm,
    weighted: Vector,
    facet_area: Vector,
    coordinates: Vector,
    user_normal: VectorField | None,
    label: str,
) -> tuple[Vector, Vector]:
    """Return unit normals (k, gdim) and the areas (k,) projected along them.

    `weighted` are the integrals of the normal, `facet_area` those of its length.
    """
    gdim = weighted.shape[1]
    length = np.linalg.norm(weighted, axis=1)
    minimum = VANISHING_NORMAL * facet_area
    if user_normal is None:
        raise_where(
            comm,
            length <= minimum,
            coordinates[:, :gdim],
            lambda number, place: (
                f"{label}: the normals of the facets around {number} nodes cancel, the first at "
                f"{place}: tag one side of an edge only, or give a normal"
            ),
        )
        return weighted / length[:, None], length
    normal = unit_vectors(comm, user_normal, coordinates, gdim, f"the normal of the {label}")
    area = np.sum(weighted * normal, axis=1)
    raise_where(
        comm,
        area <= minimum,
        coordinates[:, :gdim],
        lambda number, place: (
            f"the normal of the {label} points into the body or along its surface at {number} "
            f"nodes, the first at {place}: it has to point out of the slave, as the facets' do"
        ),
    )
    return normal, area


def _facets_at_nodes(
    comm: MPI.Intracomm, corners: Vector, vertices: Numbers, nodes: Numbers
) -> tuple[Vector, Vector]:
    """Return the mean edge length of the smallest facet and the facets' area at each node.

    Collective. The area is the integral of the node's shape function over all ranks' facets.
    """
    # of a segment both edges are the segment
    edges = np.roll(corners, -1, axis=1) - corners
    mean = np.linalg.norm(edges, axis=2).mean(axis=1)
    areas = np.linalg.norm(corner_normals(corners), axis=2)
    directory = Directory(comm, np.unique(vertices))
    keys, sizes, areas = directory.collect(
        vertices.ravel(), np.repeat(mean, vertices.shape[1]), areas.ravel()
    )
    rows, count = directory.position(keys), directory.keys.size
    smallest = np.full(count, np.inf)
    np.minimum.at(smallest, rows, sizes)
    _, size, area = directory.lookup(nodes, smallest, np.bincount(rows, areas, count))
    return size, area
