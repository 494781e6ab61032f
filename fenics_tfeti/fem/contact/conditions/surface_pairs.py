"""The conditions of pairs of surfaces, of many pairs at once (sec. 11.1).

The surfaces of all pairs are joined to one slave and one master, whose nodes are there once for
each pair, see `ContactNodes`: what is found for one pair of surfaces is found for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    Conditions,
    ContactConditions,
    JoinedPairs,
    separated,
)
from fenics_tfeti.fem.contact.conditions.mortars import NodesWithoutConditions, mortar_conditions
from fenics_tfeti.fem.contact.conditions.node_pairs import match_nodes, meshes_match, shared_nodes
from fenics_tfeti.fem.contact.conditions.summary import matching_summaries
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, Patch
from fenics_tfeti.fem.contact.descriptions.partners import Nearest, NodePartners
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.descriptions.ties import BondedPair
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.normals import axes_of_cylinders
from fenics_tfeti.fem.contact.surfaces.oriented import oriented_facets
from fenics_tfeti.fem.contact.surfaces.patches import connected_facets, patch_colours
from fenics_tfeti.fem.contact.surfaces.tagged import (
    MeshBoundary,
    Surface,
    split,
    surface_of,
    tagged_facets,
)
from fenics_tfeti.fem.geometry.integrals import integrate
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.user_data import scalars_at
from fenics_tfeti.parallel import concatenate_ranks, largest_of_groups, raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

NamedPair: TypeAlias = tuple[str, ContactPair]
Parts: TypeAlias = Mapping[int, tuple[NamedPair, Indices, Indices]]  # facets of slave and master


def match_pairs(
    boundary: MeshBoundary, pairs: Sequence[NamedPair], fixed: Mask
) -> list[list[ContactConditions]]:
    """Find the slave's nodes, normals, partners and gaps of pairs, this rank's part. Collective.

    A pair has several parts where its surfaces have sharp edges or its masters share no nodes: in
    each of them a node has one condition at most, see `patches`.

    Of the master's facets each rank gets those near its slave facets. Pairs with normals or
    partners of the user are matched one by one, all others at once. For the mask see
    `prescribed_components`.
    """
    if not pairs:
        return []
    for name, contact in pairs:
        if isinstance(contact.partners, NodePartners) and boundary.degree > 1:
            raise InputError(
                f"{name}: partners={type(contact.partners).__name__}(...) asks for conditions "
                "between pairs of nodes, which are for displacements of degree 1; this one is of "
                f"degree {boundary.degree}. Leave it out: the conditions are mortar conditions then"
            )
    tagged = [
        (contact.facet_tags, tag, f"{role} of {name}")
        for name, contact in pairs
        for role, tag in zip(("slave", "master"), surface_tags(contact), strict=True)
    ]
    is_patch = [isinstance(contact, Patch) for _, contact in pairs]
    facets = tagged_facets(boundary, tagged, np.repeat(is_patch, 2))
    whole = dict(enumerate(zip(pairs, facets[::2], facets[1::2], strict=True)))
    found: list[list[ContactConditions]] = [[] for _ in pairs]
    for k, (_, contact) in enumerate(pairs):
        if contact.normal is not None or isinstance(contact.partners, NodePartners):
            found[k] = [*_matched(boundary, {0: whole.pop(k)}, fixed).values()]
    if whole:
        numbers, parts = _split(boundary, whole)
        matched = _matched(boundary, parts, fixed)
        for part, number in enumerate(numbers):
            found[number].append(matched[part])
    return found


def _split(boundary: MeshBoundary, whole: Parts) -> tuple[list[int], Parts]:
    """Return the numbers of the pairs that parts belong to, and the parts. Collective.

    Each is of faces of the slave and of the master that have one colour.
    """
    pairs = _joined(boundary, whole)
    sides, count = (pairs.slave, pairs.master), len(whole)
    of_facets = face_colours(pairs.slave), master_colours(pairs.slave, pairs.master)
    numbers = [
        (1 + largest_of_groups(side.comm, colour.astype(float), side.facet_contact, count, -1.0))
        .astype(int)
        .tolist()
        for side, colour in zip(sides, of_facets, strict=True)
    ]
    colours = (
        split(side.facet_contact, colour, count)
        for side, colour in zip(sides, of_facets, strict=True)
    )
    of_parts, parts = [], []
    for (k, (pair, slave, master)), faces, bodies, of_slave, of_master in zip(
        whole.items(), *numbers, *colours, strict=True
    ):
        # one without facets is a part, too
        for a, b in product(range(max(faces, 1)), range(max(bodies, 1))):
            of_parts.append(k)
            parts.append((pair, slave[of_slave == a], master[of_master == b]))
    return of_parts, dict(enumerate(parts))


def _matched(
    boundary: MeshBoundary, parts: Parts, fixed: Mask, match: Mask | None = None
) -> dict[int, ContactConditions]:
    """Match pairs that are alike in the user's partners and normals, by number. Collective.

    Of which of them the meshes match is found if it is not known.
    """
    pairs = _joined(boundary, parts)
    contacts, slave, prescribed = pairs.contacts, pairs.slave, None
    how = contacts[0].partners
    if not isinstance(how, NodePartners):
        master = gather_nearby(pairs.master, slave)
        if match is None:
            match = np.array([contact.partners is None for contact in contacts])
            match &= boundary.degree == 1
            if match.any():
                match &= meshes_match(slave, master, Nearest().tolerance)
        if match.any() and not match.all():
            kinds = [
                {k: part for (k, part), chosen in zip(parts.items(), mask, strict=True) if chosen}
                for mask in (match, ~match)
            ]
            known = match[match], match[~match]
            first, second = (
                _matched(boundary, kind, fixed, of_kind)
                for kind, of_kind in zip(kinds, known, strict=True)
            )
            return first | second
        how = Nearest() if match.all() else None
    if how is not None:
        found = match_nodes(pairs, how)
    else:
        prescribed = slave.boundary.nodes.copied(fixed)[slave.local]
        without = NodesWithoutConditions.of(slave, shared_nodes(pairs, master.nodes), prescribed)
        given, none = contacts[0].normal is not None, np.zeros(0, dtype=np.int64)
        found = mortar_conditions(slave, master, without, none, given)
        check_weight(found, slave)
    return dict(zip(parts, _conditions_of_parts(boundary, pairs, found, prescribed), strict=True))


def _joined(boundary: MeshBoundary, parts: Parts) -> JoinedPairs:
    """Return the pairs with the slave and the master of the facets of all of them. Collective."""
    pairs, *sides = zip(*parts.values(), strict=True)
    names, contacts = zip(*pairs, strict=True)
    every = [*sides[0], *sides[1]]
    sizes = [part.size for part in every]
    facets = oriented_facets(boundary.space, np.concatenate(every))
    joined, of_sides = _joined_boundary(boundary, facets, sizes)
    slave, master = (
        surface_of(joined, part, names, role, normal)
        for role, part, normal in zip(
            ("slave", "master"), of_sides, (contacts[0].normal, None), strict=True
        )
    )
    slave, master = (
        replace(surface, depth=_depths(contacts, part))
        for surface, part in zip((slave, master), sides, strict=True)
    )
    return JoinedPairs(contacts, slave, master)


def _depths(contacts: Sequence[ContactPair], facets: Sequence[Indices]) -> Vector | None:
    """Return how far behind facets the other surfaces may be [m]; None if none is of a patch."""
    if not any(isinstance(contact, Patch) for contact in contacts):
        return None
    depths = (
        contact.depth_at(part) if isinstance(contact, Patch) else np.full(part.size, np.inf)
        for contact, part in zip(contacts, facets, strict=True)
    )
    return np.concatenate([np.zeros(0), *depths])


def _joined_boundary(
    boundary: MeshBoundary, facets: Indices, sizes: Sequence[int]
) -> tuple[MeshBoundary, list[Indices]]:
    """Return a boundary with the nodes of each contact, and the facets of both sides. Collective.

    The facets (f, t) are those of the contacts' slaves, then those of the masters, of these sizes.
    """
    count = len(sizes) // 2
    joined, nodes = boundary.joined(facets, np.repeat(np.arange(2 * count) % count, sizes))
    return joined, np.split(nodes, [sum(sizes[:count])])


@dataclass(frozen=True)
class MortarPairs:
    """Pairs with mortar conditions, whose surfaces are joined once for all displacements.

    Either all of them have normals of the user, or none.
    """

    boundary: MeshBoundary  # undeformed
    pairs: JoinedPairs
    without: NodesWithoutConditions

    @staticmethod
    def of(found: Sequence[tuple[ContactPair, ContactConditions]]) -> MortarPairs:
        """Join the surfaces of conditions. Collective."""
        contacts, conditions = zip(*found, strict=True)
        sides = [[part.surfaces[side] for part in conditions] for side in (0, 1)]
        surfaces = [*sides[0], *sides[1]]
        boundary = surfaces[0].boundary
        joined, of_sides = _joined_boundary(
            boundary,
            np.concatenate([surface.facet_nodes for surface in surfaces]),
            [len(surface.facet_nodes) for surface in surfaces],
        )
        slave, master = (
            Surface.joined(joined, *side) for side in zip(sides, of_sides, strict=True)
        )
        shared = concatenate_ranks(slave.comm, np.intersect1d(slave.nodes, master.nodes))
        prescribed = np.concatenate([part.prescribed for part in conditions])
        without = NodesWithoutConditions.of(slave, shared, prescribed)
        return MortarPairs(boundary, JoinedPairs(contacts, slave, master), without)

    def at(
        self,
        deformed: MeshBoundary,
        before: Sequence[ContactConditions],
        normals: Sequence[Vector] | None,
    ) -> list[ContactConditions]:
        """Return the conditions on a deformed boundary, with gaps of the surfaces. Collective.

        Nodes that had conditions before keep them longer than others. The user's normals (k, gdim)
        are those at the nodes of each slave.
        """
        names, there = self.pairs.slave.names, self.pairs.slave.boundary.moved_as(deformed)
        slave, master = (side.on(there) for side in (self.pairs.slave, self.pairs.master))
        if normals is None:
            slave = slave.with_present_normals()
        else:
            slave = replace(slave, normal=np.concatenate(normals))
        near = gather_nearby(master, slave)
        with raise_collectively(slave.comm):
            near.check_not_folded(*names)
        first = np.cumsum([0, *(part.surface.nodes.size for part in before)])
        rows = [start + part.on_surface for start, part in zip(first, before, strict=False)]
        known = slave.nodes[np.concatenate(rows)]
        found = mortar_conditions(slave, near, self.without, known, normals is not None)
        check_weight(found, self.pairs.slave)
        gap = np.sum(found.gap * found.normal, axis=1)
        parts = separated(self.boundary, self.pairs.slave, found, gap)
        return [replace(part, **new) for part, new in zip(before, parts, strict=True)]


def face_colours(slave: Surface) -> Numbers:
    """Return the colours (f,) of the smooth faces of slaves that this rank's facets are in.

    Collective.
    """
    face, vertices = _smooth_faces(slave), slave.boundary.nodes.to_global(slave.vertices)
    return patch_colours(slave, face, vertices.ravel(), np.repeat(face, vertices.shape[1]))


def master_colours(slave: Surface, master: Surface) -> Numbers:
    """Return the colours (f,) of the smooth faces of masters, of this rank's facets. Collective."""
    face = _smooth_faces(master)
    if master.comm.allreduce(int(face.max(initial=-1)), MPI.MAX) + 1 <= len(master.names):
        return np.zeros_like(face)
    near, part = gather_nearby(master, slave, face), slave.part()
    integrals = integrate(part.facets, near.facets)
    corners = part.nodes[part.facets.corners[integrals.facet[integrals.pair]]]
    assert near.number is not None
    at_corners = np.repeat(near.number[integrals.master], corners.shape[1])
    return patch_colours(master, face, corners.ravel(), at_corners)


def _smooth_faces(surface: Surface) -> Numbers:
    """Return the number, over all ranks, of the face of each facet (f,) of this rank. Collective.

    Faces end at edges at which their normals turn by more than 60 degrees.
    """
    vertices = surface.boundary.nodes.to_global(surface.vertices)
    ends = vertices[..., None]
    if surface.corners.shape[2] == 3:
        ends = np.sort(np.stack([vertices, np.roll(vertices, -1, axis=1)], axis=2), axis=2)
    facet = np.repeat(np.arange(len(vertices)), vertices.shape[1])
    normal = unit(facet_normals(surface.corners))[facet]
    keys = ends.reshape(facet.size, surface.corners.shape[2] - 1)
    return connected_facets(surface.comm, keys, facet, len(vertices), normal)


def _conditions_of_parts(
    boundary: MeshBoundary, pairs: JoinedPairs, found: Conditions, prescribed: Mask | None
) -> list[ContactConditions]:
    """Return the conditions of each pair, with initial gaps and the mesh's nodes. Collective."""
    slave, names, comm = pairs.slave, pairs.slave.names, pairs.slave.comm
    rows = slave.rows_of(found.terms.slave)
    contact, places = slave.contact[rows], slave.coordinates[rows]
    gap = slave.without_rounding(np.sum(found.gap * found.normal, axis=1), contact)
    accuracy = found.accuracy()
    bonded = np.array([isinstance(pair, BondedPair) for pair in pairs.contacts])[contact]
    if any(isinstance(pair, BondedPair) for pair in pairs.contacts):
        slave.check_joined(np.where(bonded, np.linalg.norm(found.gap, axis=1), 0.0), rows)
    gap = initial_gaps(comm, pairs.contacts, contact, gap, accuracy.chord, places, names)
    deviation = accuracy.deviation
    summaries = matching_summaries(
        comm,
        names,
        "node_to_node" if prescribed is None else "mortar",
        contact,
        gap,
        accuracy.angle,
        slave.contact,
        accuracy.distance,
        slave.size[rows],
        found.area,
        accuracy.covered_area,
        None if deviation is None else slave.without_rounding(deviation, contact),
    )
    for pair, summary in zip(pairs.contacts, summaries, strict=True):
        if pair.initial_gap != "geometric":
            summary.update(deviation=None, blurred=None)
        if prescribed is not None:
            summary.update(slave=pair.slave, master=pair.master)
    axes: list[Vector | None] = [None] * len(names)
    if pairs.contacts[0].normal is None:
        axes = axes_of_cylinders(slave, found.terms.slave, found.normal)
    columns = zip(
        separated(boundary, slave, found, gap),
        summaries,
        slave.separated(boundary),
        pairs.master.separated(boundary),
        split(slave.contact, prescribed, len(names)),
        axes,
        strict=True,
    )
    return [
        ContactConditions(
            summary=summary,
            surface=surface,
            master_surface=master_surface,
            prescribed=of_surface,
            axes=of_nodes,
            **part,
        ).across(of_nodes)
        for part, summary, surface, master_surface, of_surface, of_nodes in columns
    ]


def initial_gaps(
    comm: MPI.Intracomm,
    pairs: Sequence[ContactPair],
    contact: Numbers,
    gap: Vector,
    chord: Vector,
    points: Vector,
    names: Sequence[str],
) -> Vector:
    """Return the initial gaps (k,) of conditions of contacts (k,). Collective.

    For the values see `ContactPair`. The gaps (k,) are those of the mesh, the chords the distances
    of its facets from the curved surfaces there [m].
    """
    touching = np.array([pair.initial_gap == "touching" for pair in pairs])
    # twice: the normals at a surface's border see half of the curvature
    gap = np.where(touching[contact] & (np.abs(gap) <= 2.0 * chord), 0.0, gap)
    for k, (pair, name) in enumerate(zip(pairs, names, strict=True)):
        if not isinstance(pair.initial_gap, str):
            rows = contact == k
            gap[rows] = user_gaps(comm, pair.initial_gap, points[rows], name)
    return gap


def user_gaps(comm: MPI.Intracomm, value: Any, points: Vector, name: str) -> Vector:
    """Evaluate the gaps (k,) that a user gives at points (k, 3). Collective."""
    return scalars_at(comm, value, points, points.shape[1], f"{name}: initial_gap")


def check_weight(conditions: Conditions, slave: Surface) -> None:
    """Check that the conditions of a slave have areas. Collective."""
    if slave.boundary.weight is not None:
        slave.check_weight(conditions.area, slave.rows_of(conditions.terms.slave))


def check_covered(slaves: Sequence[Surface], covered: Sequence[int], rows: Sequence[int]) -> None:
    """Check that masters cover a part of each slave, and more than slivers. Collective.

    Of each slave there are the numbers of this rank's covered facets and conditions.
    """
    if not slaves:
        return
    totals = np.array([covered, rows])
    slaves[0].comm.Allreduce(MPI.IN_PLACE, totals)
    for contact in np.flatnonzero(totals[0] == 0)[:1]:
        raise InputError(
            f"{slaves[contact].names[0]}: no facet of the slave has a facet of the master opposite "
            "it: along the normals the surfaces never meet, or they face away from each other. "
            "Surfaces that touch face each other: is one of the tags on the far side of its body, "
            "or on another body?"
        )
    for contact in np.flatnonzero(totals[1] == 0)[:1]:
        slave = slaves[contact]
        bad = slave.first_wrong(np.ones(slave.nodes.size, dtype=bool))
        assert bad is not None
        raise InputError(
            f"{bad.name}: the master covers slivers of {totals[0, contact]} slave "
            f"facets only, too little for any of the {bad.number} slave nodes, the first at "
            f"{bad.place}. Tag surfaces that lie over each other, not ones that meet at an edge"
        )
