"""Tagged surfaces: the nodes that this rank owns, with normals, areas and sizes of facets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx.fem import Constant, Function, FunctionSpace
from dolfinx.mesh import Mesh
from ufl.algorithms import extract_arguments
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_domains

from fenics_tfeti.errors import InputError, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets, owned_facets
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets, folded
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.normals import corner_normals
from fenics_tfeti.fem.geometry.reference_cells import facet_type
from fenics_tfeti.fem.geometry.vectors import edge_lengths
from fenics_tfeti.fem.messages import WrongPoints, coordinate_order, first_wrong
from fenics_tfeti.fem.nodes import ContactNodes, NodeMap
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, RELATIVE_ROUNDING, VANISHING_NORMAL
from fenics_tfeti.fem.topology import (
    Tag,
    cell_facets,
    cell_type,
    cell_vertices,
    each_tag,
    exterior_facets,
    vertex_nodes,
)
from fenics_tfeti.fem.user_data import VectorField, unit_vectors
from fenics_tfeti.parallel import (
    concatenate_ranks,
    largest_of_groups,
    largest_of_ranks,
    raise_collectively,
)
from fenics_tfeti.typing import Array, Indices, Mask, Numbers, Vector


@dataclass(frozen=True)
class MeshBoundary:
    """Data of the boundary of a mesh that all its tagged surfaces share."""

    space: FunctionSpace  # that of the displacement
    nodes: NodeMap  # its nodes
    coordinates: Vector  # (nodes, 3): of this rank's nodes, ghosts last [m]
    # whether each facet of this rank is on the boundary; False for ghosts
    exterior: Mask
    # factor of ds in the forms, at the local nodes at vertices (nodes,) after a displacement; None
    # without one
    weight: Callable[[Function | None], Vector] | None
    displacement: Function | None = None  # of the nodes; None in the undeformed state

    @staticmethod
    def of(space: FunctionSpace, measure_weight: Any = None) -> MeshBoundary:
        """Find the boundary of a space's mesh. Collective."""
        domain, coordinates = space.mesh, space.tabulate_dof_coordinates()
        with raise_collectively(domain.comm):
            weight = as_ufl_weight(domain, measure_weight)
        at_vertices = None if weight is None else _weight_at_vertices(space, weight)
        exterior = exterior_facets(domain)
        cells = np.flatnonzero(exterior[cell_facets(domain)].any(axis=1))
        # dolfinx maps the nodes from the reference cell, with rounding
        vertices = domain.geometry.x[cell_vertices(domain)[cells]]
        coordinates[vertex_nodes(space)[cells]] = vertices
        return MeshBoundary(space, NodeMap(space), coordinates, exterior, at_vertices)

    def joined(self, facet_nodes: Indices, contact: Numbers) -> tuple[MeshBoundary, Indices]:
        """Return it with the nodes of each contact, and the facets with their numbers. Collective.

        The facets (f, t) of the contacts (f,) have local nodes.
        """
        nodes = ContactNodes(self.nodes, facet_nodes, contact)
        joined = replace(self, nodes=nodes, coordinates=nodes.copied(self.coordinates))
        return joined, nodes.facet_nodes

    def moved_as(self, deformed: MeshBoundary) -> MeshBoundary:
        """Return it with its nodes where those that they are copies of are on a deformed one."""
        return replace(
            self,
            coordinates=self.nodes.copied(deformed.coordinates),
            displacement=deformed.displacement,
        )

    def deformed(self, displacement: Function) -> MeshBoundary:
        """Return the boundary with displaced nodes; ghosts of the displacement are up to date."""
        moves = self.nodes.values(displacement)
        x = self.coordinates.copy()
        x[:, : moves.shape[1]] += moves
        return replace(self, coordinates=x, displacement=displacement)

    @property
    def degree(self) -> int:
        """Degree of the displacement, 1 or 2."""
        return _compat.element_facts(self.space)[1]

    def nodal_weight(self) -> Vector | None:
        """Evaluate the weight at all local nodes at vertices; None without one. Collective."""
        return None if self.weight is None else self.nodes.copied(self.weight(self.displacement))


@dataclass(frozen=True)
class Surface:
    """Tagged surfaces, one of each contact; of the nodes at vertices, those that this rank owns.

    Surfaces of several contacts have `ContactNodes`, by whose numbers they are apart.
    """

    boundary: MeshBoundary
    names: Sequence[str]  # of the contacts
    role: str  # "slave" or "master"; empty if the name is that of the surface
    nodes: Numbers  # global nodes of the displacement's space at the vertices of facets (k,)
    normal: Vector  # outward unit normals (k, gdim)
    area: Vector  # (k,): turns a uniform pressure into the normal force, without weight [m^2 or m]
    size: Vector  # (k,): mean edge length of the smallest of the facets at the node [m]
    facet_nodes: Indices  # (f, t): local nodes of the facets that it owns; see `oriented_facets`
    extent: Vector  # largest coordinates of each surface by magnitude, over all ranks [m]
    depth: Vector | None = None  # (f,), as of `Facets`

    def on(self, boundary: MeshBoundary, normal: Vector | None = None) -> Surface:
        """Return the surface at other places of the nodes. Collective.

        Without normals (k, gdim) there it keeps the normals and areas that it has.
        """
        surface = replace(self, boundary=boundary)
        if normal is None:
            return surface
        surface = replace(surface, normal=normal)
        return replace(surface, area=surface.share_of_area(surface.whole))

    @property
    def whole(self) -> Mask:
        """All facets, (f,)."""
        return np.ones(len(self.facet_nodes), dtype=bool)

    @property
    def comm(self) -> MPI.Intracomm:
        """The ranks."""
        return self.boundary.nodes.comm

    @property
    def labels(self) -> list[str]:
        """The names of the contacts' surfaces in messages."""
        return [f"{self.role} of {name}" if self.role else name for name in self.names]

    @cached_property
    def local(self) -> Numbers:
        """Local numbers of the nodes (k,)."""
        return self.nodes - self.boundary.nodes.first

    @cached_property
    def contact(self) -> Numbers:
        """The contacts of the nodes (k,)."""
        return self._contact_of(self.local)

    @cached_property
    def facet_contact(self) -> Numbers:
        """The contacts of the facets (f,)."""
        return self._contact_of(self.facet_nodes[:, 0])

    def _contact_of(self, local: Numbers | Indices) -> Numbers:
        contact = self.boundary.nodes.contact
        return np.zeros(len(local), dtype=np.int64) if contact is None else contact[local]

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
        facet, _ = facet_type(self.normal.shape[1] - 1, self.facet_nodes.shape[1])
        return self.facet_nodes[:, : facet.vertices]

    @cached_property
    def corners(self) -> Vector:
        """The places (f, v, gdim) of the facets' corners [m]."""
        return self.boundary.coordinates[self.vertices, : self.normal.shape[1]]

    def counts(self, *of_contacts: Numbers) -> Array:
        """Return how often each contact is among those of each array (q,). Collective."""
        counts = [np.bincount(contact, minlength=len(self.names)) for contact in of_contacts]
        return self.comm.allreduce(np.array(counts))

    def rows_of(self, nodes: Numbers) -> Numbers:
        """Return the positions (q,) of some of its nodes."""
        return np.searchsorted(self.nodes, nodes)

    def first_wrong(self, wrong: Mask, rows: Numbers | slice = slice(None)) -> WrongPoints | None:
        """Return what is wrong at all or some of the nodes, see `first_wrong`. Collective."""
        return first_wrong(self.comm, wrong, self.points[rows], self.contact[rows], self.names)

    def check_separate(self, master: Mask, remedy: str) -> None:
        """Check that none of the nodes (k,) is one of the master. Collective."""
        if bad := self.first_wrong(master):
            raise InputError(
                f"{bad.name}: slave and master share {bad.number} nodes, the first at {bad.place}. "
                f"{remedy}"
            )

    def check_joined(self, distance: Vector, rows: Numbers) -> None:
        """Check that some of the nodes (q,) are on the master, by distances (q,) [m]. Collective.

        What moves with the rotation of facets is no farther apart than these are large.
        """
        largest = largest_of_ranks(self.comm, distance)
        if bad := self.first_wrong(distance > 0.5 * self.size[rows], rows):
            raise InputError(
                f"{bad.name}: the surfaces are apart, or overlap, by more than half a facet at "
                f"{bad.number} slave nodes, by up to {largest:.3g}, the first at {bad.place}. Tie "
                "surfaces that lie on each other"
            )

    def without_rounding(self, lengths: Vector, contact: Numbers | int = 0) -> Vector:
        """Set lengths (q,) [m] to zero that are no more than the rounding of coordinates.

        They are those of contacts (q,), or of one.
        """
        rounding = COORDINATE_ROUNDING * self.extent[contact]
        return np.where(np.abs(lengths) <= rounding, 0.0, lengths)

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
        sums = nodes.reduce_at_owners(nodes.to_global(vertices.ravel()), flat, ufunc)
        return sums[self.local]

    def max_of_facets(self, values: Vector) -> Vector:
        """Return the largest value (k,) of the facets (f,) around each node, or 0. Collective."""
        at_corners = np.repeat(values[:, None], self.vertices.shape[1], axis=1)
        return self.sum_of_corners(at_corners, np.maximum)

    def share_of_area(self, chosen: Mask, weight: Vector | None = None) -> Vector:
        """Return the share (k,) of each node's area on chosen facets (f,). Collective."""
        x = self.boundary.coordinates[self.facet_nodes, : self.normal.shape[1]]
        at_corners = None if weight is None else weight[self.vertices]
        integrals = corner_normals(x, at_corners) * chosen[:, None, None]
        return np.sum(self.sum_of_corners(integrals) * self.normal, axis=1)

    def with_present_normals(self) -> Surface:
        """Return it with normals and areas of all facets around its nodes there. Collective."""
        x = self.boundary.coordinates[self.facet_nodes, : self.normal.shape[1]]
        integrals = corner_normals(x)
        sizes = np.linalg.norm(integrals, axis=2, keepdims=True)
        sums = self.sum_of_corners(np.concatenate([integrals, sizes], axis=2))
        length = np.linalg.norm(sums[:, :-1], axis=1)
        if bad := self.first_wrong(length <= VANISHING_NORMAL * sums[:, -1]):
            raise folded(bad.name, bad.number, bad.place)
        return replace(self, normal=sums[:, :-1] / length[:, None], area=length)

    def with_normals_of(self, covered: Vector | Mask) -> Surface:
        """Return it with normals of the covered shares (f,) of facets, where a node has some.

        They are means weighted with the shares, so that a surface that slides has normals without
        jumps. At the edge of a box whose sides are tagged, too, the normal is that of the foot.
        Collective.
        """
        x = self.boundary.coordinates[self.facet_nodes, : self.normal.shape[1]]
        sums = self.sum_of_corners(corner_normals(x) * covered[:, None, None])
        length = np.linalg.norm(sums, axis=1)
        there = length > VANISHING_NORMAL * self.area
        normal = self.normal.copy()
        normal[there] = sums[there] / length[there, None]
        return replace(self, normal=normal)

    def stretch(self, deformed: MeshBoundary, chosen: Mask) -> Vector:
        """Return the deformed over the present area of chosen facets (f,) at nodes. Collective.

        Areas are integrals of the shape function with the weight of the measure.
        """
        after, before = (surface._area_of(chosen) for surface in (self.on(deformed), self))
        # a node of facets on the axis has none
        return np.divide(after, before, out=np.ones_like(before), where=before > 0.0)

    def _area_of(self, chosen: Mask) -> Vector:
        weight = self.boundary.nodal_weight()
        x = self.boundary.coordinates[self.facet_nodes, : self.normal.shape[1]]
        integrals = corner_normals(x, None if weight is None else weight[self.vertices])
        return self.sum_of_corners(np.linalg.norm(integrals, axis=2) * chosen[:, None])

    def check_weight(self, weighted: Vector, rows: Numbers | slice = slice(None)) -> None:
        """Check that areas (k,) with the weight of the measure, at some nodes, are positive."""
        mean, contact = weighted / self.area[rows], self.contact[rows]
        if bad := self.first_wrong(~np.isfinite(mean), rows):
            raise InputError(
                f"{self.labels[bad.contact]}: measure_weight is NaN or infinite around "
                f"{bad.number} nodes, the first at {bad.place}"
            )
        largest = largest_of_groups(self.comm, np.abs(mean), contact, len(self.names), 0.0)[contact]
        if bad := self.first_wrong(mean <= RELATIVE_ROUNDING * largest, rows):
            raise InputError(
                f"{self.labels[bad.contact]}: measure_weight is negative or zero around "
                f"{bad.number} nodes, "
                f"the first at {bad.place}: as the factor of ds it has to be positive there. Has "
                "the mesh nodes of negative radius, or is a surface on the axis tagged?"
            )

    def areas(self, covered: Mask) -> Vector:
        """Return each node's area on covered facets, or all of it where it has none. Collective.

        The areas are (k,) [m^2 or m], times the weight of the measure; `covered` (f,) are the
        facets of this rank that count.
        """
        area, weight = self.area, self.boundary.nodal_weight()
        if weight is not None:
            area = self.share_of_area(self.whole, weight)
            self.check_weight(area)
        if self.comm.allreduce(bool(covered.all()), MPI.LAND):
            return area
        covered_area = self.share_of_area(covered, weight)
        return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)

    def part(
        self, chosen: Numbers | Mask | slice = slice(None), number: Numbers | None = None
    ) -> SurfaceFacets:
        """Return all or some facets of this rank, with their numbers of all (f,) if given."""
        boundary, rows = self.boundary, self.facet_nodes[chosen]
        nodes, first, inverse = np.unique(
            boundary.nodes.to_global(rows), return_index=True, return_inverse=True
        )
        local = rows.ravel()[first]
        points = boundary.coordinates[local]
        contact = None if len(self.names) == 1 else boundary.nodes.contact
        facets = Facets(
            points[:, : self.normal.shape[1]],
            inverse.reshape(rows.shape),
            None if contact is None else contact[local],
            None if self.depth is None else self.depth[chosen],
        )
        return SurfaceFacets(nodes, facets, number=None if number is None else number[chosen])

    def oriented_part(self) -> SurfaceFacets:
        """Return the facets of this rank with the surface's normals and the weight. Collective."""
        nodes, part = self.boundary.nodes, self.part()
        weight = self.boundary.nodal_weight()
        return replace(
            part,
            vertex_normals=self.normals_at(part.nodes),
            weight=None if weight is None else weight[nodes.to_local(part.nodes)],
        )

    def normals_at(self, nodes: Numbers) -> Vector:
        """Return the normals (n, gdim) at nodes of any ranks, zero at others. Collective."""
        normal = np.zeros((self.boundary.nodes.owned, self.normal.shape[1]))
        normal[self.local] = self.normal
        return self.boundary.nodes.values_at(normal, nodes)

    def gathered(self) -> SurfaceFacets:
        """Return the facets of all ranks. Collective."""
        return gather_surfaces([self])[0]

    def separated(self, boundary: MeshBoundary) -> list[Surface]:
        """Return the surface of each contact, in the numbers of the mesh's boundary."""
        originals = self.boundary.nodes.copied(np.arange(boundary.nodes.size))
        numbers, count = boundary.nodes.first + originals[self.local], len(self.names)
        at_nodes = (numbers, self.normal, self.area, self.size)
        columns = [split(self.contact, values, count) for values in at_nodes]
        facet_nodes = originals[self.facet_nodes].astype(np.int32)
        columns += [split(self.facet_contact, facet_nodes, count), np.split(self.extent, count)]
        columns += [split(self.facet_contact, self.depth, count)]
        return [
            Surface(boundary, [name], self.role, *of_contact)
            for name, *of_contact in zip(self.names, *columns, strict=True)
        ]

    @staticmethod
    def joined(
        boundary: MeshBoundary, surfaces: Sequence[Surface], facet_nodes: Indices
    ) -> Surface:
        """Return the surfaces of contacts as one, on a boundary with `ContactNodes`: as separated.

        The facets (f, t) are those of all of them, with the boundary's local nodes.
        """
        assert isinstance(boundary.nodes, ContactNodes)
        contact = np.repeat(np.arange(len(surfaces)), [part.nodes.size for part in surfaces])
        local, normal, area, size, extent = (
            np.concatenate([getattr(part, name) for part in surfaces])
            for name in ("local", "normal", "area", "size", "extent")
        )
        nodes, names = boundary.nodes.copies(contact, local), [part.names[0] for part in surfaces]
        role, depth = surfaces[0].role, None
        if surfaces[0].depth is not None:
            depth = np.concatenate([part.depth for part in surfaces if part.depth is not None])
        return Surface(boundary, names, role, nodes, normal, area, size, facet_nodes, extent, depth)

    def gathered_nodes(self) -> SurfaceNodes:
        """Return the nodes of all ranks in the order of their coordinates. Collective."""
        columns = [
            concatenate_ranks(self.comm, column)
            for column in (self.nodes, self.points, self.normal, self.size, self.contact)
        ]
        # of equally near nodes, the same is then chosen however the mesh is distributed
        order = coordinate_order(columns[1])
        return SurfaceNodes(*(column[order] for column in columns))


@dataclass(frozen=True)
class SurfaceNodes:
    """All nodes of a surface, on every rank and in one order for any number of ranks."""

    nodes: Numbers  # global nodes (m,)
    points: Vector  # (m, gdim) [m]
    normal: Vector  # outward unit normals (m, gdim)
    size: Vector  # (m,): mean edge length of the smallest of the facets at the node [m]
    contact: Numbers  # (m,)

    def without(self, nodes: Numbers) -> SurfaceNodes:
        """Leave out some nodes."""
        kept = ~np.isin(self.nodes, nodes)
        return SurfaceNodes(*(column[kept] for column in vars(self).values()))


def joined_surfaces(boundary: MeshBoundary, surfaces: Sequence[Surface]) -> Surface:
    """Return the surfaces of contacts, of the nodes of a boundary, as one. Collective."""
    sizes = [len(surface.facet_nodes) for surface in surfaces]
    facets = np.concatenate([surface.facet_nodes for surface in surfaces])
    joined, nodes = boundary.joined(facets, np.repeat(np.arange(len(sizes)), sizes))
    return Surface.joined(joined, surfaces, nodes)


def gather_surfaces(surfaces: Sequence[Surface]) -> list[SurfaceFacets]:
    """Return the facets of all ranks of some surfaces in one message, as `gathered`. Collective."""
    if not surfaces:
        return []
    of_ranks = surfaces[0].comm.allgather([surface.part() for surface in surfaces])
    return [SurfaceFacets.joined(parts) for parts in zip(*of_ranks, strict=True)]


def tagged_surface(
    boundary: MeshBoundary,
    facet_tags: Any,
    tag: Tag,
    name: str,
    role: str = "",
    user_normal: VectorField | None = None,
) -> Surface:
    """Find the nodes of a tagged surface, this rank's part. Collective."""
    label = f"{role} of {name}" if role else name
    (facets,) = tagged_facets(boundary, [(facet_tags, tag, label)])
    return surface_of(boundary, oriented_facets(boundary.space, facets), [name], role, user_normal)


def tagged_surfaces(
    boundary: MeshBoundary, tagged: Sequence[tuple[Any, Tag, str]], role: str
) -> list[Surface]:
    """Find the nodes of a surface for each (meshtags, tag, contact), all at once. Collective."""
    if not tagged:
        return []
    names = [name for *_, name in tagged]
    facets = tagged_facets(
        boundary, [(tags, tag, f"{role} of {name}") for tags, tag, name in tagged]
    )
    contact = np.repeat(np.arange(len(facets)), [part.size for part in facets])
    nodes = oriented_facets(boundary.space, np.concatenate(facets))
    return surface_of(*boundary.joined(nodes, contact), names, role).separated(boundary)


def tagged_facets(
    boundary: MeshBoundary, tagged: Sequence[tuple[Any, Tag, str]], may_be_empty: Mask | None = None
) -> list[Indices]:
    """Return this rank's facets of each (meshtags, tag, label), checked. Collective.

    Those that may have no facets at all are the same on all ranks.
    """
    domain, comm = boundary.space.mesh, boundary.nodes.comm
    dim = domain.topology.dim - 1
    with raise_collectively(comm):
        for facet_tags, _, label in tagged:
            if not _compat.tags_are_on(facet_tags, domain):
                raise InputError(
                    f"{label}: facet_tags belong to another mesh than the displacement"
                )
            if facet_tags.dim != dim:
                raise InputError(
                    f"{label}: facet_tags are on entities of dimension {facet_tags.dim}, facets "
                    f"have dimension {dim}"
                )
    labels = [label for *_, label in tagged]
    single = [(k, tag) for k, (_, tags, _) in enumerate(tagged) for tag in each_tag(tags)]
    surface = np.array([k for k, _ in single])
    parts = [owned_facets(domain, tagged[k][0], tag) for k, tag in single]
    of_surface = np.split(np.arange(len(parts)), np.flatnonzero(np.diff(surface)) + 1)
    facets = [np.sort(np.concatenate([parts[m] for m in own])) for own in of_surface]
    of_tags = np.array([part.size for part in parts])
    comm.Allreduce(MPI.IN_PLACE, of_tags)
    number = np.bincount(surface, of_tags, len(tagged)).astype(int)
    is_missing = (of_tags == 0) if may_be_empty is None else (of_tags == 0) & ~may_be_empty[surface]
    for k, tag in (single[m] for m in np.flatnonzero(is_missing)[:1]):
        facet_tags, _, label = tagged[k]
        existing = np.unique(concatenate_ranks(comm, np.unique(facet_tags.values))).tolist()
        raise InputError(f"{label}: tag {tag} is on no facet; the tags there are {existing}")
    every = np.concatenate(facets)
    inside = ~boundary.exterior[every]
    nodes = oriented_facets(boundary.space, every[inside])
    middles = boundary.coordinates[nodes[:, : cell_type(domain).facet.vertices]].mean(axis=1)
    places = np.zeros((every.size, domain.geometry.dim))
    places[inside] = middles[:, : domain.geometry.dim]
    of_facets = np.repeat(np.arange(len(tagged)), [part.size for part in facets])
    if bad := first_wrong(comm, inside, places, of_facets, labels):
        raise InputError(
            f"{bad.name}: {bad.number} of the {number[bad.contact]} facets with tag "
            f"{tagged[bad.contact][1]} are inside a body, or between bodies that share their "
            f"nodes, the first around {bad.place}: only facets on the boundary can touch. Bodies "
            "that share nodes, as Gmsh's fragment makes them, get nodes of their own by "
            "fenics_tfeti.io.split_interfaces"
        )
    return facets


def surface_of(
    boundary: MeshBoundary,
    facet_nodes: Indices,
    names: Sequence[str],
    role: str,
    user_normal: VectorField | None = None,
) -> Surface:
    """Return the surfaces of facets (f, t), this rank's part; see `tagged_surface`. Collective."""
    nodes, comm, gdim = boundary.nodes, boundary.nodes.comm, boundary.nodes.components
    x = boundary.coordinates[facet_nodes, :gdim]
    vertices = facet_nodes[:, : cell_type(boundary.space.mesh).facet.vertices]
    numbers = nodes.to_global(vertices.ravel())
    weighted = corner_normals(x)
    sizes = np.linalg.norm(weighted, axis=2, keepdims=True)
    # of a segment both edges are the segment
    edges = edge_lengths(x[:, : vertices.shape[1]]).mean(axis=1)
    local = np.unique(nodes.to_owners(numbers)[0])
    integrals = np.concatenate([weighted, sizes], axis=2).reshape(-1, gdim + 1)
    sums = nodes.reduce_at_owners(numbers, integrals)[local]
    size = nodes.reduce_at_owners(numbers, np.repeat(edges, vertices.shape[1]), np.minimum)[local]
    none = np.zeros((0, gdim))
    area, extent = sums[:, gdim], np.zeros(len(names))
    surface = Surface(
        boundary, names, role, local + nodes.first, none, area, size, facet_nodes, extent
    )
    coordinates, contact = boundary.coordinates[local], surface.contact
    extent = largest_of_groups(comm, np.abs(coordinates).max(axis=1), contact, len(names), 0.0)
    normal, area = _normals_and_areas(sums[:, :gdim], surface, user_normal)
    return replace(surface, normal=normal, area=area, extent=extent)


def split(contact: Numbers, values: Array | None, count: int) -> list[Any]:
    """Return the values (k, ...) of each of the contacts (k,), which ascend."""
    if values is None:
        return [None] * count
    if count == 1:
        return [values]
    return np.split(values, np.searchsorted(contact, np.arange(1, count)))


def _normals_and_areas(
    weighted: Vector, surface: Surface, user_normal: VectorField | None
) -> tuple[Vector, Vector]:
    """Return unit normals and areas (k,) from integrals of the normal and of its length."""
    length = np.linalg.norm(weighted, axis=1)
    minimum = VANISHING_NORMAL * surface.area
    if user_normal is None:
        if bad := surface.first_wrong(length <= minimum):
            raise InputError(
                f"{surface.labels[bad.contact]}: the normals of the facets around {bad.number} "
                f"nodes cancel, the first at {bad.place}: tag one side of an edge only, or give a "
                "normal"
            )
        return weighted / length[:, None], length
    (label,) = surface.labels
    x, gdim = surface.coordinates, weighted.shape[1]
    normal = unit_vectors(surface.comm, user_normal, x, gdim, f"the normal of the {label}")
    area = np.sum(weighted * normal, axis=1)
    if bad := surface.first_wrong(area <= minimum):
        raise InputError(
            f"the normal of the {label} points into the body or along its surface at {bad.number} "
            f"nodes, the first at {bad.place}: it has to point out of the slave, as the facets' do"
        )
    return normal, area


def _weight_at_vertices(space: FunctionSpace, weight: Any) -> Callable[[Function | None], Vector]:
    """Compile a weight, to be evaluated at the displaced vertices of a mesh. Collective.

    Functions in it move with the nodes; x in it is where they are.
    """
    scalar, moved = Function(_compat.lagrange_space(space.mesh, 1)), Function(space)
    x = ufl.SpatialCoordinate(space.mesh)
    weight = ufl.replace(weight, {x: x + moved})
    compiled = _compat.compiled_expression(weight, scalar.function_space)
    # the two spaces may number their nodes differently
    at, source = vertex_nodes(space), vertex_nodes(scalar.function_space)

    def at_vertices(displacement: Function | None) -> Vector:
        moved.x.array[:] = 0.0 if displacement is None else displacement.x.array
        scalar.interpolate(compiled)
        scalar.x.scatter_forward()
        values = np.zeros(NodeMap(space).size)
        values[at] = scalar.x.array[source]
        return values

    return at_vertices


def as_ufl_weight(domain: Mesh, weight: Any) -> Any:
    """Return the weight of the measure as an expression of UFL, checked; None for none."""
    if weight is None:
        return None
    if isinstance(weight, int | float | np.number) and not isinstance(weight, bool):
        # a Constant: for each number in the expression, code would be compiled anew
        return Constant(domain, float(weight))
    if not isinstance(weight, Expr):
        expected = "a scalar expression of UFL or a number, such as 2 * ufl.pi * x[0],"
        raise wrong_type("measure_weight", weight, expected)
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
