"""What is checked of matched surfaces, and what is reported of them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.contact.matching import Match
from fenics_tfeti.fem.contact.surfaces import FACET_EDGES, MasterNodes, Surface
from fenics_tfeti.parallel import concatenate_ranks

__all__ = [
    "angles_between",
    "check_not_crossed",
    "check_one_to_one",
    "check_partners",
    "pairing_entry",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

_NAMED = 3  # places in a message
# of the product of two edges: the rounding of edges at right angles
_ROUNDING = 1e-9
# of unit vectors that differ by rounding
_SAME = 1e-13


def check_partners(
    comm: MPI.Intracomm,
    slave: Surface,
    match: Match,
    limit: Vector,
    partial: bool,
    name: str,
) -> None:
    """Check that all slave nodes have a partner, or in a partial contact some.

    Raises
    ------
    InputError
        With the first places, how far they miss, and what would help.
    """
    far = match.distance > limit
    missing, total = comm.allreduce(int(far.sum())), comm.allreduce(far.size)
    if missing == 0 or (partial and missing < total):
        return
    relative = match.distance[far] / slave.size[far]
    finite = comm.allreduce(float(relative[np.isfinite(relative)].max(initial=0.0)), MPI.MAX)
    columns = (slave.points[far], match.distance[far], limit[far])
    rows = _first(comm, columns, _NAMED)
    some = "; ".join(
        f"{format_point(point, slave.extent)} at distance {distance:.3g} (tolerance {most:.3g})"
        if np.isfinite(distance)
        else f"{format_point(point, slave.extent)}"
        for point, distance, most in zip(*rows, strict=True)
    )
    free = "" if partial else ", or let them be free by partial=True"
    what = (
        f"Distances are {match.measure}, up to {finite:.2g} of the facets' size. " if finite else ""
    )
    raise InputError(
        f"{name}: {missing} of {total} slave nodes have no partner: {some}. {what}{match.cure}"
        f"{free}"
    )


def check_one_to_one(
    comm: MPI.Intracomm,
    slave: Surface,
    master: MasterNodes,
    match: Match,
    matched: NDArray[np.bool_],
    partial: bool,
    name: str,
) -> None:
    """Check that no two slave nodes have the same partner.

    Raises
    ------
    InputError
        With the first places and what would help.
    """
    partner = match.partner[matched]
    shared, counts = np.unique(concatenate_ranks(comm, partner), return_counts=True)
    shared = shared[counts > 1]
    if not shared.size:
        return
    concerned = matched & np.isin(match.partner, shared)
    relative = match.distance[concerned] / slave.size[concerned]
    columns = (slave.points[concerned], match.partner[concerned], relative)
    points, partners, relative = (concatenate_ranks(comm, column) for column in columns)
    # all but the nearest of each master node have to go
    order = np.lexsort((relative, partners))
    second = order[1:][partners[order][1:] == partners[order][:-1]]
    # the master's nodes are in the order of their coordinates
    both = points[partners == shared[0]]
    places = " and ".join(
        format_point(point, slave.extent) for point in both[np.lexsort(both.T[::-1])]
    )
    cure = (
        "Exchange slave and master, or mesh the surfaces alike"
        if not partial
        else f"With a tolerance below {relative[second].min():.2g} some of them stay free; or "
        "exchange slave and master, or mesh the surfaces alike"
    )
    raise InputError(
        f"{name}: {shared.size} master nodes are each the partner of several slave nodes, the "
        f"first at {format_point(master.points[shared[0]], slave.extent)} of those at {places}; "
        f"the mapping has to be one to one. {cure}"
    )


def check_not_crossed(
    comm: MPI.Intracomm,
    slave: Surface,
    corners: Vector,
    normals: Vector,
    images: Vector,
    name: str,
) -> None:
    """Check that neighbouring slave nodes have their partners in the same order along the surface.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    slave : Surface
        The slave's surface.
    corners, normals, images : (f, v, gdim) arrays
        Nodes of this rank's facets, the normals there, and the partners' coordinates, NaN where
        there is none.
    name : str
        Name of the contact.

    Raises
    ------
    InputError
        With the first edge and what would help.
    """
    gdim = images.shape[2]
    edges = np.array(FACET_EDGES[images.shape[1]])
    ends, ends_normals, partners = (
        of_facets[:, edges].reshape(-1, 2, gdim) for of_facets in (corners, normals, images)
    )
    normal = ends_normals.sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0.0)
    # along the surface only: gaps may differ from node to node
    edge = _tangential(ends[:, 1] - ends[:, 0], normal)
    image = partners[:, 1] - partners[:, 0]
    product = np.linalg.norm(edge, axis=1) * np.linalg.norm(image, axis=1)
    image = _tangential(image, normal)
    crossed = np.sum(edge * image, axis=1) < -_ROUNDING * product  # false where there is a NaN

    found = np.concatenate([ends[crossed], partners[crossed]], axis=1)
    # an edge belongs to two facets: once only, and by the smaller end
    swap = _comes_before(found[:, 1], found[:, 0])
    found[swap] = found[swap][:, [1, 0, 3, 2]]
    found = np.unique(concatenate_ranks(comm, found.reshape(-1, 4 * gdim)), axis=0)
    if not len(found):
        return
    a, b, of_a, of_b = (format_point(p, slave.extent) for p in found[0].reshape(4, gdim))
    raise InputError(
        f"{name}: pairs cross on {len(found)} edges of slave facets: the neighbours {a} and {b} "
        f"have the partners {of_a} and {of_b}, which lie in the opposite order. Correct the pairs, "
        "mapping or direction, or lower the pair's tolerance"
    )


def pairing_entry(
    comm: MPI.Intracomm,
    name: str,
    gap: Vector,
    angle: Vector,
    total: int,
    distance: Vector | None = None,
    relative: Vector | None = None,
) -> dict[str, Any]:
    """Summarise a contact for the pairing table; the same on all ranks.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    name : str
        Name of the contact.
    gap, angle : (k,) arrays
        Gaps [m] and angles between slave's normals and the opposite of their partners' [degrees].
    total : int
        Number of slave nodes that this rank owns, matched or not.
    distance, relative : (k,) arrays, optional
        What the tolerance limits [m], and relative to the facets' size; none for obstacles.

    Returns
    -------
    dict
        An entry of `Report.pairing`.
    """
    pairs = comm.allreduce(gap.size)

    def largest(values: Vector) -> float:
        return float(comm.allreduce(float(values.max(initial=-np.inf)), MPI.MAX))

    return {
        "contact": name,
        "pairs": pairs,
        "unmatched": comm.allreduce(total) - pairs,
        "largest_distance": None if distance is None else largest(distance),
        "largest_relative_distance": None if relative is None else largest(relative),
        "largest_angle": largest(angle),
        "smallest_gap": 0.0 - largest(-gap),
        "largest_gap": largest(gap),
    }


def angles_between(first: Vector, second: Vector) -> Vector:
    """Return the angles between unit vectors (k, gdim), row by row [degrees]."""
    # exact for small angles, unlike the inverse cosine
    chord = np.linalg.norm(first - second, axis=1)
    chord[chord < _SAME] = 0.0
    angle: Vector = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))
    return angle


def _tangential(vectors: Vector, normal: Vector) -> Vector:
    tangential: Vector = vectors - np.sum(vectors * normal, axis=1)[:, None] * normal
    return tangential


def _comes_before(first: Vector, second: Vector) -> NDArray[np.bool_]:
    """Compare points row by row, by their first different coordinate."""
    different = first != second
    at = np.argmax(different, axis=1)
    rows = np.arange(len(first))
    before: NDArray[np.bool_] = first[rows, at] < second[rows, at]
    return before


def _first(comm: MPI.Intracomm, columns: tuple[Vector, ...], number: int) -> list[Vector]:
    """Return the first rows over all ranks, by the first column: few of each rank are sent."""

    def sort(rows: list[Vector]) -> list[Vector]:
        order = np.lexsort(rows[0].T[::-1])[:number]
        return [row[order] for row in rows]

    mine = sort(list(columns))
    return sort([concatenate_ranks(comm, row) for row in mine])
