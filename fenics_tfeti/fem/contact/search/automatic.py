"""Contact pairs of all bodies that are near each other, without tags of their surfaces."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh, meshtags

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.checks.cells import check_cells
from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair, SelfContact
from fenics_tfeti.fem.contact.descriptions.friction import FrictionLaw
from fenics_tfeti.fem.contact.search.opposite import ExteriorFacets, OppositeFacets
from fenics_tfeti.fem.contact.search.self_contact import SelfPatches
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.decomposition.bodies import Bodies, find_bodies
from fenics_tfeti.fem.geometry.vectors import edge_lengths
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.topology import distinct_rows
from fenics_tfeti.fem.user_data import check_positive
from fenics_tfeti.parallel import (
    Directory,
    concatenate_ranks,
    first_of_rank,
    largest_of_groups,
    largest_of_ranks,
    raise_collectively,
    send_rows,
    warn_on_first_rank,
)
from fenics_tfeti.typing import Indices, Mask, Numbers

# angle by which facets that touch face to face may be inclined before [rad]
_INCLINED = 0.1
# how far the nearest bodies are looked for where there are no contacts, in longest edges
_FAR = 10.0


def find_contacts(
    mesh: Mesh,
    cell_tags: Any | None = None,
    *,
    distance: float | None = None,
    friction: FrictionLaw | None = None,
    whole_faces: bool = False,
    itself: bool = False,
) -> list[ContactPair]:
    """Return contact pairs of all bodies that are near each other. Collective.

    A facet on the boundary of a body belongs to a pair if a facet of the other body is opposite it
    along its normal, within the distance; of several bodies one behind the other it is the nearest.
    Facets of bodies that are glued to each other are not paired, those of one body if asked for.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    cell_tags : MeshTags, optional
        The bodies, as for `ContactProblem`; by default the connected parts of the mesh.
    distance : float, optional
        Largest gap between facets [m]. A part of a surface that may touch later has to be within
        it. By default it is the shortest edge of the facet. Without `whole_faces`, that of facets
        which are inclined to each other by more than 0.1 rad is the one where their bodies are
        nearest to others; a warning has the pairs of bodies that are left out.
    friction : Tresca or Coulomb, optional
        The law of friction of all pairs; by default there is none.
    whole_faces : bool
        Whether surfaces are extended to the edges of their bodies, for bodies that slide along each
        other by more than a facet.
    itself : bool
        Whether parts of one body that are opposite each other, with nothing between them, are
        paired, too: the faces of cracks and slots. At finite strains `SelfContact` follows them.

    Returns
    -------
    list of ContactPair
        By the numbers of the bodies, which names have. The slave is the body with the larger
        facets; where sizes vary, the ratio of opposite facets counts where it is largest. Where
        slave facets meet at a sharp edge there is a pair for either side. The list is empty, with
        a warning, where no bodies are near each other.

    Raises
    ------
    InputError
        On all ranks, for a distance that is no positive number, or wrong cell tags.

    Examples
    --------
    >>> from fenics_tfeti.io import Box, boxes
    >>> slabs = [Box((0, 0, k), (3, 2, k + 1), divisions=(3, 2, 2)) for k in range(3)]
    >>> pile = boxes(MPI.COMM_SELF, slabs)
    >>> for pair in find_contacts(pile.mesh, pile.cell_tags):
    ...     print(pair.name, len(pair.facet_tags.find(pair.slave)))
    body 0 (cell tag 1) on body 1 (cell tag 2) 6
    body 1 (cell tag 2) on body 2 (cell tag 3) 6
    """
    comm = mesh.comm
    with raise_collectively(comm):
        if distance is not None:
            check_positive(distance, "find_contacts: the distance")
    bodies = find_bodies(mesh, cell_tags)
    check_cells(mesh, bodies)
    facets = ExteriorFacets.of(mesh, bodies)
    opposite = OppositeFacets.find(comm, facets, distance)
    opposite = opposite.chosen(_is_apart(comm, opposite, bodies))
    if distance is None and not whole_faces:
        opposite = opposite.chosen(_may_touch(comm, opposite, bodies))
    opposite = opposite.chosen(_is_from_slave(comm, opposite))
    surfaces = _surfaces(comm, opposite.rows, facets, whole_faces)
    contacts = _of_themselves(mesh, facets, bodies, distance, friction) if itself else []
    if not surfaces and not contacts:
        _warn_of_nothing(comm, facets, bodies, itself)
    for number, ((slave, master, side), tagged) in enumerate(surfaces.items()):
        first, second = bodies.labels[slave], bodies.labels[master]
        contacts.append(
            ContactPair(
                meshtags(mesh, mesh.topology.dim - 1, *tagged),
                slave=2 * number + 1,
                master=2 * number + 2,
                name=f"{first} on {second}" + (f", side {side + 1}" if side else ""),
                friction=friction,
            )
        )
    return contacts


def _of_themselves(
    mesh: Mesh,
    facets: ExteriorFacets,
    bodies: Bodies,
    distance: float | None,
    friction: FrictionLaw | None,
) -> list[ContactPair]:
    """Return the pairs of parts of one body, of each body. Collective."""
    order, contacts = np.argsort(facets.number), list[ContactPair]()
    columns = facets.number[order], 1 + facets.body[order]
    tags = meshtags(mesh, mesh.topology.dim - 1, *(c.astype(np.int32) for c in columns))
    space = _compat.lagrange_space(mesh, 1, mesh.geometry.dim)
    boundary = MeshBoundary.of(space, None)
    for body, label in enumerate(bodies.labels):
        whole = SelfContact(tags, 1 + body, distance=distance, friction=friction)
        found = SelfPatches.of(boundary, whole, label, is_far=False).at(None)
        for number, pair in enumerate(() if found.is_empty else found.pairs):
            name = f"{label} on itself" + (f", patch {number + 1}" if number else "")
            contacts.append(
                ContactPair(
                    pair.facet_tags,
                    pair.slave,
                    pair.master,
                    name=name,
                    friction=friction,
                    partial=True,
                )
            )
    return contacts


def _is_apart(comm: MPI.Intracomm, opposite: OppositeFacets, bodies: Bodies) -> Mask:
    """Tell which pairs are of bodies that are not glued; warn of those that are. Collective."""
    of_bodies = opposite.rows[:, :2]
    first, second = bodies.part[of_bodies].T
    glued = first == second
    pairs = distinct_rows(concatenate_ranks(comm, np.sort(of_bodies[glued], axis=1)))[0]
    if len(pairs):
        warn_on_first_rank(
            comm,
            f"find_contacts: {len(pairs)} pairs of bodies are near each other, but get no "
            "contact, because they are connected through facets: the first "
            f"{_joined(bodies, pairs[0])}. Where they may touch, tag their surfaces and add a "
            "ContactPair",
        )
    return ~glued


def _joined(bodies: Bodies, pair: Iterable[int]) -> str:
    """Return the names of a pair of bodies."""
    return " and ".join(bodies.names[body] for body in pair)


def _may_touch(comm: MPI.Intracomm, opposite: OppositeFacets, bodies: Bodies) -> Mask:
    """Tell which pairs may touch with small strains; warn of bodies without one. Collective.

    Facets that are inclined do not become parallel then: they touch where their bodies are
    nearest to others, within the size of the facets there.
    """
    gap, reach, of_bodies = opposite.gap, opposite.reach, opposite.rows[:, :2].T
    body, count, gaps, reaches = of_bodies.ravel(), len(bodies.names), *np.tile([gap, reach], 2)
    nearest = -largest_of_groups(comm, -gaps, body, count, -np.inf)
    there = gaps <= nearest[body] + SAME_PLACE * reaches
    size = largest_of_groups(comm, reaches[there], body[there], count, 0.0)
    may_touch: Mask = gap <= size[of_bodies].max(axis=0)
    may_touch |= opposite.cosine >= np.cos(_INCLINED)
    pair = np.max(of_bodies, axis=0) * count + np.min(of_bodies, axis=0)
    kept = np.unique(concatenate_ranks(comm, np.unique(pair[may_touch])))
    lost = ~np.isin(pair, kept)
    number = np.unique(concatenate_ranks(comm, np.unique(pair[lost]))).size
    least, nearest_pair = opposite.chosen(lost).nearest(comm)
    if number:
        warn_on_first_rank(
            comm,
            f"find_contacts: {number} pairs of bodies get no contact, because they are "
            "farther apart than the facets are large where these bodies are nearest to others: "
            f"the nearest {_joined(bodies, nearest_pair)}, with a gap of {least:.3g}. Where they "
            "may touch, pass "
            f"contacts=find_contacts(mesh, cell_tags, distance={1.01 * least:.3g})",
        )
    return may_touch


def _warn_of_nothing(
    comm: MPI.Intracomm, facets: ExteriorFacets, bodies: Bodies, itself: bool
) -> None:
    """Warn that there are no contacts, and say how far apart the nearest bodies are. Collective."""
    if len(bodies.names) == 1 and not itself:
        warn_on_first_rank(
            comm,
            "find_contacts: there is one body alone, which gets no contact. Parts of it that face "
            "each other are paired with itself=True; bodies that share nodes are one body until "
            "fenics_tfeti.io.split_interfaces gives them nodes of their own",
        )
        return
    reach = _FAR * largest_of_ranks(comm, edge_lengths(facets.corners))
    found = OppositeFacets.find(comm, facets, reach)
    first, second = bodies.part[found.rows[:, :2]].T
    gap, pair = found.chosen(first != second).nearest(comm)
    if pair:
        advice = (
            f"The smallest gap is {gap:.3g}, between {_joined(bodies, pair)}: where it may close, "
            f"pass contacts=find_contacts(mesh, cell_tags, distance={1.01 * gap:.3g})"
        )
    else:
        advice = f"Up to a gap of {reach:.3g} no facet is opposite to one of another body"
    warn_on_first_rank(
        comm,
        f"find_contacts: none of {len(bodies.names)} bodies are near each other, there is no "
        f"contact between them. {advice}",
    )


def _is_from_slave(comm: MPI.Intracomm, opposite: OppositeFacets) -> Mask:
    """Tell which pairs are of the two bodies' slave. Collective.

    The condition number grows with the size of the master's facets over that of the slave's
    opposite them. The slave is the body for which the largest such ratio is the smaller one, of
    equal ones that with the lower number; a body without facets that are near the other is none.
    """
    ratio, is_lower = opposite.ratio, opposite.rows[:, 0] < opposite.rows[:, 1]
    ratios = np.where(is_lower, [ratio, 1.0 / ratio], [1.0 / ratio, ratio])
    values = np.column_stack([*ratios, is_lower, ~is_lower])
    pairs, inverse = distinct_rows(np.sort(opposite.rows[:, :2], axis=1))
    every, inverse_of = distinct_rows(concatenate_ranks(comm, pairs))
    first = first_of_rank(comm, len(pairs))[0]
    pair = inverse_of[first + inverse]
    largest = largest_of_groups(comm, values, pair, len(every), 0.0)
    as_lower, as_higher, lower_is_near, higher_is_near = largest.T
    lower = (as_lower <= (1.0 + RELATIVE_ROUNDING) * as_higher) | (higher_is_near == 0.0)
    lower &= lower_is_near > 0.0
    return is_lower == lower[pair]


def _surfaces(
    comm: MPI.Intracomm, opposite: Numbers, facets: ExteriorFacets, whole_faces: bool
) -> dict[tuple[int, int, int], tuple[Indices, Indices]]:
    """Return this rank's facets of each pair, ascending, and their tags. Collective.

    The keys, alike on all ranks, are the bodies of slave and master and the side of the slave. The
    tags of slaves are 1, 3, ..., those of masters 2, 4, ....
    """
    face = facets.faces(comm)
    slaves = distinct_rows(opposite[:, :3])[0]
    if whole_faces:
        slaves = _extended(comm, slaves, face)
    side_of = _sides(comm, slaves, facets, face)

    def keys(rows: Numbers) -> Numbers:
        distinct, inverse = distinct_rows(np.column_stack([rows[:, :2], face[rows[:, 2]]]))
        distinct[:, 2] = [side_of.get((a, b, number), 0) for a, b, number in distinct.tolist()]
        return distinct[inverse]

    slaves = np.column_stack([keys(slaves), slaves[:, 2]])
    masters = distinct_rows(np.column_stack([keys(opposite[:, :3]), opposite[:, 3]]))[0]
    masters = _sent_to_owners(comm, masters, facets.number.size)
    if whole_faces:
        masters = _extended(comm, masters, face)
    pairs = distinct_rows(concatenate_ranks(comm, distinct_rows(slaves[:, :3])[0]))[0]
    rows = np.concatenate([slaves, masters])
    pair = distinct_rows(np.concatenate([pairs, rows[:, :3]]))[1][len(pairs) :]
    facet = facets.number[rows[:, 3]]
    tag = 2 * pair + np.repeat([1, 2], [len(slaves), len(masters)])
    order = np.lexsort((facet, pair))
    facet, tag = (column[order].astype(np.int32) for column in (facet, tag))
    ends = np.searchsorted(pair[order], np.arange(len(pairs) + 1)).tolist()
    tagged = [(facet[i:j], tag[i:j]) for i, j in pairwise(ends)]
    return dict(zip(map(tuple, pairs.tolist()), tagged, strict=True))


def _extended(comm: MPI.Intracomm, rows: Numbers, face: Numbers) -> Numbers:
    """Return rows (n, k) of a pair and a facet with all facets of their faces. Collective."""
    whole = distinct_rows(np.column_stack([rows[:, :-1], face[rows[:, -1]]]))[0]
    whole = distinct_rows(concatenate_ranks(comm, whole))[0]
    order = np.argsort(face, kind="stable")
    begin, end = (np.searchsorted(face[order], whole[:, -1], side) for side in ("left", "right"))
    number = end - begin
    place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    facet = order[np.repeat(begin, number) + place]
    return np.column_stack([np.repeat(whole[:, :-1], number, axis=0), facet])


def _sides(
    comm: MPI.Intracomm, slaves: Numbers, facets: ExteriorFacets, face: Numbers
) -> dict[tuple[int, int, int], int]:
    """Return the side of faces of a slave that meet others of the same pair. Collective.

    Of the slave's faces that have a common node, each gets a side of its own. The keys are two
    bodies and a face; faces that meet no others are not there, they are on side 0.
    """
    pairs, facet = slaves[:, :2], slaves[:, 2]
    faces = np.column_stack([pairs, face[facet]])
    vertices = facets.vertices[facet]
    directory = Directory(comm, np.unique(vertices))
    vertex, rows = directory.collect(vertices.ravel(), np.repeat(faces, vertices.shape[1], axis=0))
    rows = distinct_rows(np.column_stack([rows[:, :2], vertex, rows[:, 2]]))[0]
    meetings = [np.zeros((0, 4), dtype=np.int64)]
    for step in range(1, len(rows)):
        meet = (rows[step:, :3] == rows[:-step, :3]).all(axis=1)
        if not meet.any():
            break
        meetings.append(np.column_stack([rows[step:][meet][:, [0, 1, 3]], rows[:-step][meet, 3]]))
    neighbours: dict[tuple[int, int, int], set[int]] = {}
    for a, b, *ends in concatenate_ranks(comm, np.concatenate(meetings)).tolist():
        for first, second in (ends, ends[::-1]):
            neighbours.setdefault((a, b, first), set()).add(second)
    places: dict[tuple[int, int, int], list[Any]] = {}
    for key, corners in zip(map(tuple, faces.tolist()), facets.corners[facet], strict=True):
        if key in neighbours:
            places.setdefault(key, []).extend(map(tuple, corners.tolist()))
    parts = comm.allgather({key: (min(x), max(x)) for key, x in places.items()})
    # the order of faces does not depend on how facets are distributed
    place = {}
    for key in neighbours:
        low, high = zip(*(part[key] for part in parts if key in part), strict=True)
        place[key] = min(low), max(high)
    side_of: dict[tuple[int, int, int], int] = {}
    for key in sorted(neighbours, key=lambda key: (key[:2], place[key])):
        taken = {side_of.get((*key[:2], other)) for other in neighbours[key]}
        side_of[key] = min(set(range(len(taken) + 1)) - taken)
    return side_of


def _sent_to_owners(comm: MPI.Intracomm, rows: Numbers, owned: int) -> Numbers:
    """Send rows, the last column a facet's number over all ranks, to its owner. Collective.

    Of those that arrive, each once, the last column is the facet on this rank.
    """
    firsts = np.cumsum([0, *comm.allgather(owned)])
    rank = np.searchsorted(firsts, rows[:, -1], "right") - 1
    (arrived,) = send_rows(comm, rank, rows)
    arrived[:, -1] -= firsts[comm.rank]
    return distinct_rows(arrived)[0]
