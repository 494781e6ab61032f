"""The conditions of pairs of surfaces, of many pairs at once (sec. 11.1).

The surfaces of all pairs are joined to one slave and one master, whose nodes are there once for
each pair, see `ContactNodes`: what is found for one pair of surfaces is found for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise, product
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    Conditions,
    ContactConditions,
    JoinedPairs,
    PressureShares,
)
from fenics_tfeti.fem.contact.conditions.mortars import mortar_conditions
from fenics_tfeti.fem.contact.conditions.node_pairs import match_nodes, meshes_match, shared_nodes
from fenics_tfeti.fem.contact.conditions.summary import matching_summaries
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, Patch
from fenics_tfeti.fem.contact.descriptions.partners import Nearest, NodePartners
from fenics_tfeti.fem.contact.descriptions.surfaces import surface_tags
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.normals import without_axial_tilt
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
from fenics_tfeti.fem.nodes import ContactNodes
from fenics_tfeti.fem.user_data import scalars_at
from fenics_tfeti.parallel import largest_of_groups
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
        shared, none = shared_nodes(pairs, master.nodes), np.zeros(0, dtype=np.int64)
        given = contacts[0].normal is not None
        found = mortar_conditions(slave, master, shared, prescribed, none, given)
        check_weight(found, slave)
    return dict(zip(parts, _conditions_of_parts(boundary, pairs, found, prescribed), strict=True))


def _joined(boundary: MeshBoundary, parts: Parts) -> JoinedPairs:
    """Return the pairs with the slave and the master of the facets of all of them. Collective."""
    pairs, *sides = zip(*parts.values(), strict=True)
    names, contacts = zip(*pairs, strict=True)
    every = [*sides[0], *sides[1]]
    sizes = [part.size for part in every]
    facets = oriented_facets(boundary.space, np.concatenate(every))
    nodes = ContactNodes(
        boundary.nodes, facets, np.repeat(np.arange(len(every)) % len(names), sizes)
    )
    joined = replace(boundary, nodes=nodes, coordinates=nodes.copied(boundary.coordinates))
    slave, master = (
        surface_of(joined, part, names, role, normal)
        for role, part, normal in zip(
            ("slave", "master"),
            np.split(nodes.facet_nodes, [sum(sizes[: len(names)])]),
            (contacts[0].normal, None),
            strict=True,
        )
    )
    return JoinedPairs(contacts, slave, master)


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
    normal = found.normal
    if pairs.contacts[0].normal is None:
        normal = without_axial_tilt(slave, found.terms.slave, normal)
    copies, count = slave.boundary.nodes, len(names)
    numbers = copies.copied(boundary.nodes.first + np.arange(boundary.nodes.size))
    terms = replace(found.terms, nodes=copies.values_at(numbers, found.terms.nodes))
    ends = np.searchsorted(contact, np.arange(count + 1))
    shares: list[PressureShares | None] = [None] * count
    if found.shares is not None:
        S, size = found.shares.matrix, (rows.size, boundary.nodes.total)
        S = sp.csr_matrix((S.data, copies.values_at(numbers, S.indices), S.indptr), size)
        shares = [PressureShares(partial(S.__getitem__, slice(*cut))) for cut in pairwise(ends)]
    columns = [
        terms.split(ends),
        *(split(contact, values, count) for values in (normal, gap, found.area)),
        summaries,
        slave.separated(boundary),
        split(slave.facet_contact, found.covered, count),
        split(contact, found.coverage, count),
        split(slave.contact, prescribed, count),
        pairs.master.separated(boundary),
        shares,
    ]
    return list(map(ContactConditions, *columns))


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
