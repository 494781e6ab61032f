"""Contact of a surface with itself: which of its facets face each other, kept up to date.

Each rank has all facets of the surface, and looks for what is in front of its own. What faces each
other becomes patches, each with a slave and a master (`patches_of_itself`), which stay as they are
as long as they have all pairs of facets that are near each other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import is_
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from dolfinx.fem import Function
from dolfinx.mesh import meshtags

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.descriptions.contacts import Patch, SelfContact
from fenics_tfeti.fem.contact.descriptions.partners import Mortar
from fenics_tfeti.fem.contact.descriptions.surfaces import SurfacePair, contact_name, surface_tags
from fenics_tfeti.fem.contact.search.patches_of_itself import (
    Patches,
    beside_opposed,
    find_patches,
    widened,
)
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_facets
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.facets import (
    Planes,
    reference_coordinates,
    shape_functions,
)
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import edge_lengths, unit
from fenics_tfeti.fem.messages import coordinate_order
from fenics_tfeti.fem.topology import cell_type, distinct_rows
from fenics_tfeti.parallel import any_rank, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# by default: how far facets are looked for in front and behind, in longest facets
_FAR, _BEHIND = 10.0, 3.0
# by how much farther when patches are made anew, so that they last
_MARGIN = 2.0
# rings of facets around what faces each other, for surfaces that slide
_RINGS = 2
# shape functions of points on the edge of a facet
_ON_EDGE = 1e-9
# depth behind a facet, relative to its size, up to which another one touches it
_TOUCHES = 1e-3
# depth of facets in no patch, relative to the smallest, that is told
_VISIBLE = 0.05
# facets behind a wall that have come in are farther along the surface than this many thicknesses
_AROUND = 4.0

# tells which pairs of facets count, of slaves, masters and gaps (p,)
_Choice: TypeAlias = Callable[[Numbers, Numbers, Vector], Mask]


@dataclass(frozen=True)
class Facing:
    """Pairs (p, 2) of facets, each once, and their gaps (p,) [m]."""

    pairs: Numbers
    gap: Vector


@dataclass(frozen=True)
class WholeSurface:
    """All facets of a surface, the same on every rank, in the order of their places."""

    boundary: MeshBoundary
    facets: Indices  # local numbers of this rank's facets
    corners: Indices  # (., v): their local nodes
    own: Numbers  # their rows among all
    nodes: Numbers  # (f, v): rows of points, oriented as in `Facets`
    points: Vector  # (n, gdim): undeformed [m]
    first: Numbers  # (n,): where a node is first, among the corners of all ranks' facets
    # (f,): of the undeformed wall behind each facet [m], infinite where that is more than twice the
    # depth, or where its other side is not of this surface
    thickness: Vector
    # of each pair of surfaces that other contacts or ties join, which of the facets (f,) they have
    joined: Sequence[tuple[Mask, Mask]] = ()

    @staticmethod
    def of(
        boundary: MeshBoundary, contact: SelfContact, label: str, others: Mapping[int, SurfacePair]
    ) -> WholeSurface:
        """Gather the surface, which others, by number, may join to another one. Collective."""
        comm, gdim = boundary.nodes.comm, boundary.nodes.components
        facets = _facets(boundary, contact, label)
        local = oriented_facets(boundary.space, facets)
        local = local[:, : cell_type(boundary.space.mesh).facet.vertices]
        numbers = concatenate_ranks(comm, boundary.nodes.to_global(local))
        x = concatenate_ranks(comm, boundary.coordinates[local, :gdim])
        order = coordinate_order(x.mean(axis=1))
        row = np.empty(order.size, dtype=np.int64)
        row[order] = np.arange(order.size)
        _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        # by places, on which alone roles then depend
        by_place = coordinate_order(x.reshape(-1, gdim)[first])
        row_of = np.empty(first.size, dtype=np.int64)
        row_of[by_place], first = np.arange(first.size), first[by_place]
        nodes = row_of[inverse].reshape(numbers.shape)[order]
        points = x.reshape(-1, gdim)[first]
        begin = first_of_rank(comm, len(local))[0]
        own = row[begin : begin + len(local)]
        unknown = np.full(len(nodes), np.inf)
        surface = WholeSurface(boundary, facets, local, own, nodes, points, first, unknown)
        sides = [
            (pair.facet_tags, tag, contact_name(pair, k))
            for k, pair in others.items()
            for tag in surface_tags(pair)
        ]
        on_sides = list(map(surface._has, tagged_facets(boundary, sides))) if sides else []
        joined = list(zip(on_sides[::2], on_sides[1::2], strict=True))
        return replace(surface, thickness=surface._thickness(), joined=joined)

    def _has(self, facets: Indices) -> Mask:
        """Tell which of the facets (f,) are among this rank's or another's. Collective."""
        own = self.own[np.isin(self.facets, facets)]
        found = np.zeros(len(self.nodes), dtype=bool)
        found[concatenate_ranks(self.boundary.nodes.comm, own)] = True
        return found

    def places(self, displacement: Function | None) -> Vector:
        """Return where the nodes (n, gdim) are [m]. Collective."""
        if displacement is None:
            return self.points
        displacement.x.scatter_forward()
        boundary, gdim = self.boundary.deformed(displacement), self.points.shape[1]
        x = concatenate_ranks(boundary.nodes.comm, boundary.coordinates[self.corners, :gdim])
        return x.reshape(-1, gdim)[self.first]

    @cached_property
    def size(self) -> Vector:
        """The longest edge of each facet, (f,) [m]."""
        return edge_lengths(self.points[self.nodes]).max(axis=1)

    @cached_property
    def area(self) -> Vector:
        """The area of each facet (f,) [m^2; m in 2D]."""
        return np.linalg.norm(facet_normals(self.points[self.nodes]), axis=1)

    @cached_property
    def adjacent(self) -> sp.csr_matrix:
        """Which facets have common nodes, (f, f)."""
        row = np.repeat(np.arange(len(self.nodes)), self.nodes.shape[1])
        incidence = sp.csr_matrix((np.ones(row.size), (row, self.nodes.ravel())))
        return (incidence @ incidence.T).tocsr()

    def facing(self, x: Vector, reach: Vector, patches: Patches) -> Facing:
        """Return the pairs of facets that face each other at places of the nodes. Collective.

        They are in front of each other within reach (f,) [m], or behind by up to half the
        thickness (f,) of the wall that they have come into [m]. No contact or tie joins them.
        """
        depth = np.minimum(0.5 * self.thickness, self.depth)

        def is_chosen(s: Numbers, m: Numbers, gap: Vector) -> Mask:
            kept = (gap <= reach[s]) & (gap >= -np.minimum(depth[s], depth[m]))
            for first, second in self.joined:
                kept &= ~((first[s] & second[m]) | (second[s] & first[m]))
            deep = np.flatnonzero(kept & (gap < -_TOUCHES * self.size[s]))
            pairs = np.column_stack([s[deep], m[deep]])
            unknown = deep[~patches.has(pairs)]
            kept[unknown] = self._are_far_along(s[unknown], m[unknown])
            return kept

        near = self._nearest(x, np.maximum(reach, self.depth), is_chosen)
        kept = ~beside_opposed(near.pairs, unit(facet_normals(x[self.nodes])))
        return Facing(near.pairs[kept], near.gap[kept])

    @property
    def depth(self) -> float:
        """Up to which depth one looks behind facets for those that have come in [m]."""
        return _BEHIND * float(self.size.max())

    def _thickness(self) -> Vector:
        """Return how thick the wall is behind each facet (f,) [m]. Collective."""
        found = self._nearest(
            self.points,
            np.full(len(self.nodes), 2.0 * self.depth),
            lambda s, m, gap: gap < -_TOUCHES * self.size[s],
        )
        thickness = np.full(len(self.nodes), np.inf)
        np.minimum.at(thickness, found.pairs.ravel(), np.repeat(-found.gap, 2))
        return thickness

    def _nearest(self, x: Vector, reach: Vector, is_chosen: _Choice) -> Facing:
        """Return the facets nearest to the middles of others, of those that are chosen. Collective.

        They are opposed, and have no common node.
        """
        planes, tree = Planes.of(x[self.nodes]), BoxTree(x[self.nodes])
        found = [(np.zeros((0, 2), dtype=np.int64), np.zeros(0))]
        for block in batches(self.own.size, 8192):
            s, m, gap = _pierced(planes, tree, self.own[block], x[self.nodes], reach)
            kept = is_chosen(s, m, gap)
            kept &= ~(self.nodes[s][:, :, None] == self.nodes[m][:, None, :]).any(axis=(1, 2))
            s, m, gap = s[kept], m[kept], gap[kept]
            order = np.lexsort((m, np.abs(gap), s))
            nearest = order[np.unique(s[order], return_index=True)[1]]
            pairs = np.sort(np.stack([s[nearest], m[nearest]], axis=1), axis=1)
            found.append((pairs, gap[nearest]))
        comm = self.boundary.nodes.comm
        pairs, gap = (
            concatenate_ranks(comm, np.concatenate(part)) for part in zip(*found, strict=True)
        )
        distinct, inverse = distinct_rows(pairs)
        least = np.full(len(distinct), np.inf)
        np.minimum.at(least, inverse, gap)
        return Facing(distinct, least)

    def _are_far_along(self, s: Numbers, m: Numbers) -> Mask:
        """Tell which pairs of facets are far apart along the surface: others are of one wall."""
        limit = _AROUND * np.minimum(self.thickness[s], self.thickness[m])
        limit, far = np.where(np.isfinite(limit), limit, 0.0), np.ones(s.size, dtype=bool)
        for rows in np.array_split(np.arange(s.size), max(1, s.size // 64)):
            if rows.size:
                source, inverse = np.unique(s[rows], return_inverse=True)
                length = dijkstra(self._lengths, indices=source, limit=float(limit[rows].max()))
                far[rows] = length[inverse, m[rows]] > limit[rows]
        return far

    @cached_property
    def _lengths(self) -> sp.csr_matrix:
        """The distances of the middles of adjacent facets, (f, f) [m]."""
        links, middle = self.adjacent.tocoo(), self.points[self.nodes].mean(axis=1)
        length = np.linalg.norm(middle[links.row] - middle[links.col], axis=1)
        return sp.csr_matrix((length, (links.row, links.col)), shape=links.shape)


def _pierced(
    planes: Planes, tree: BoxTree, rows: Numbers, x: Vector, reach: Vector
) -> tuple[Numbers, Numbers, Vector]:
    """Return pairs of facets: of rows (k,), and those that their normals meet, with gaps [m].

    The lines go through the middles of facets with corners x (f, v, gdim), up to the reach (f,) on
    both sides, and meet facets that are opposed by more than 96 degrees.
    """
    arm = (reach[:, None] * np.abs(planes.normal))[rows]
    low, high = planes.origin[rows] - arm, planes.origin[rows] + arm

    def meets_box(row: Numbers, box_low: Vector, box_high: Vector) -> Mask:
        meets = np.ones(row.size, dtype=bool)
        for axis in range(low.shape[1]):
            meets &= box_low[:, axis] <= high[:, axis].take(row)
            meets &= box_high[:, axis] >= low[:, axis].take(row)
        return meets

    row, m = tree.candidates(rows.size, meets_box)
    s = rows[row]
    opposed = np.einsum("kd,kd->k", planes.normal[s], planes.normal[m]) < -0.1
    s, m = s[opposed], m[opposed]
    frames = planes.project(s, x[m])
    corners = frames[..., :-1]
    xi = reference_coordinates(corners, np.zeros((s.size, 1, corners.shape[2])))[:, 0]
    shapes = shape_functions(xi, corners.shape[1])
    inside = (shapes > -_ON_EDGE).all(axis=1)
    gap = np.einsum("kv,kv->k", shapes, frames[..., -1])
    return s[inside], m[inside], gap[inside]


def _facets(boundary: MeshBoundary, contact: SelfContact, label: str) -> Indices:
    """Return this rank's facets with the tag, without tags those on the boundary. Collective."""
    if tags := surface_tags(contact):
        return tagged_facets(boundary, [(contact.facet_tags, *tags, label)])[0]
    domain = boundary.space.mesh
    owned = domain.topology.index_map(domain.topology.dim - 1).size_local
    return np.flatnonzero(boundary.exterior[:owned]).astype(np.int32)


def _check_distance(contact: SelfContact, surface: WholeSurface, name: str) -> None:
    """Check that facets are not looked for farther away than the surface is large."""
    size = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    if contact.distance is not None and contact.distance > size:
        raise InputError(
            f"{name}: the distance {contact.distance:.3g} is larger than the whole surface, "
            f"{size:.3g}: it is how far apart facets may be that are looked at together, a few "
            f"of their sizes, {surface.size.max():.3g}. In which unit is the mesh?"
        )


@dataclass(frozen=True)
class SelfPatches:
    """The patches of a surface that touches itself, and the pairs of surfaces that they are."""

    contact: SelfContact
    others: Mapping[int, SurfacePair]  # contacts and ties of two surfaces, by number
    surface: WholeSurface
    reach: Vector  # (f,) [m]
    patches: Patches
    pairs: tuple[Patch, ...]

    @staticmethod
    def of(
        boundary: MeshBoundary,
        contact: SelfContact,
        name: str,
        is_far: bool,
        others: Mapping[int, SurfacePair] | None = None,
    ) -> SelfPatches:
        """Return the contact of a surface without patches yet. Collective.

        By default facets are looked for up to a facet's shortest edge, or as `is_far` as surfaces
        go in a load step. What others join, by number, is no patch.
        """
        others = others or {}
        surface = WholeSurface.of(boundary, contact, name, others)
        _check_distance(contact, surface, name)
        shortest = edge_lengths(surface.points[surface.nodes]).min(axis=1)
        reach = np.full_like(shortest, _FAR * surface.size.max()) if is_far else shortest
        if contact.distance is not None:
            reach = np.full_like(shortest, contact.distance)
        none = Patches.none(len(surface.nodes))
        return SelfPatches(contact, others, surface, reach, none, ())._with(none)

    def is_for(self, contact: SelfContact, others: Mapping[int, SurfacePair]) -> bool:
        """Tell whether it was found for the same contact beside the same others."""
        same = map(is_, self.others.values(), others.values())
        return self.contact is contact and self.others.keys() == others.keys() and all(same)

    @property
    def is_empty(self) -> bool:
        """Whether nothing faces each other."""
        return not len(self.patches.slave)

    def at(self, displacement: Function | None) -> SelfPatches:
        """Return it for a displacement of the surface, itself if its patches still do. Collective.

        They do if they have all pairs of facets within reach.
        """
        x = self.surface.places(displacement)
        if not self._lacks(x, self.reach):
            return self
        surface, before = self.surface, self.patches.roles
        near = surface.facing(x, _MARGIN * self.reach, self.patches)
        patches, of_nodes = find_patches(near.pairs, near.gap, surface.nodes, surface.area, before)
        patches = widened(patches, of_nodes, x, surface.nodes, surface.adjacent, _RINGS)
        return self._with(patches)

    def lacks_contact(self, displacement: Function) -> bool:
        """Tell whether facets in no patch have come as near as they are large. Collective."""
        x = self.surface.places(displacement)
        return self._lacks(x, np.minimum(self.reach, self.surface.size))

    def left_inside(self, displacement: Function) -> float:
        """Return how deep facets in no patch are in others [m]; 0 outside. Collective.

        They are those at turns and ends that contradict the roles of nearer ones.
        """
        near = self.surface.facing(self.surface.places(displacement), self.reach, self.patches)
        depth = -near.gap[~self.patches.has(near.pairs)].min(initial=0.0)
        return depth if depth > _VISIBLE * self.surface.size.min() else 0.0

    def _lacks(self, x: Vector, reach: Vector) -> bool:
        near = self.surface.facing(x, reach, self.patches)
        nodes = self.surface.nodes
        known = self.patches.has(near.pairs) | self.patches.cannot_have(near.pairs, nodes)
        return any_rank(self.surface.boundary.nodes.comm, ~known)

    def _with(self, patches: Patches) -> SelfPatches:
        """Return it with other patches; pairs of the same facets are the same objects.

        Without a patch there is a pair of no facets.
        """
        surface, contact = self.surface, self.contact
        mesh = surface.boundary.space.mesh
        sides = [*zip(patches.slave, patches.master, strict=True)]
        known = {
            (slave.tobytes(), master.tobytes()): pair
            for slave, master, pair in zip(
                self.patches.slave, self.patches.master, self.pairs, strict=False
            )
        }
        if not sides:
            sides = [(np.zeros(len(surface.nodes), dtype=bool),) * 2]
        pairs = []
        for slave, master in sides:
            pair = known.get((slave.tobytes(), master.tobytes()))
            if pair is None:
                tag = np.where(slave, 1, np.where(master, 2, 0))[surface.own]
                order = np.argsort(surface.facets)
                chosen = order[tag[order] > 0]
                columns = surface.facets[chosen], tag[chosen]
                tags = meshtags(mesh, mesh.topology.dim - 1, *(c.astype(np.int32) for c in columns))
                pair = Patch(
                    tags,
                    1,
                    2,
                    name=contact.name,
                    friction=contact.friction,
                    partial=True,
                    partners=Mortar(),
                    roles="given",
                    depth=0.5 * surface.thickness[surface.own[chosen]],
                )
            pairs.append(pair)
        return replace(self, patches=patches, pairs=tuple(pairs))
