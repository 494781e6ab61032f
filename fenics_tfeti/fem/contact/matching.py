"""The search for partners: chi of sec. 11.1, from the slave's to the master's nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import isqrt
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.contact.surfaces import MasterNodes, Surface
from fenics_tfeti.fem.contact.user_data import points_of, unit_vectors, vectors_at
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively

__all__ = ["Match", "along_direction", "at_images", "by_coordinates", "nearest"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# lines that are searched at once, to bound the memory
_LINES = 4096
# nodes of one sheet of the master within the reach of a line, seen along the line: no farther
# apart than this many times the reach (a sheet as steep as 60 degrees)
_SHEET = 4.0
# at most so many nodes of a grid are equally near to a place in its middle
_EQUALLY_NEAR = 8
# of distances that are equal but for rounding
_ROUNDING = 1e-9
_CURE = (
    "mesh the two surfaces alike, tag only where they face each other, raise the pair's tolerance"
)


@dataclass(frozen=True)
class Match:
    """What was found for the slave's nodes that this rank owns.

    Attributes
    ----------
    partner : (k,) integer array
        Position among the master's nodes; -1 where there is none at all.
    distance : (k,) array
        What the tolerance limits [m]; infinite where there is no partner at all.
    measure, cure : str
        What the distance is, and what helps against too large ones, for messages.
    """

    partner: Numbers
    distance: Vector
    measure: str
    cure: str


def nearest(slave: Surface, master: MasterNodes) -> Match:
    """Match each slave node with the nearest master node; the distance is along the surface."""
    partner = _query(master.points, slave.points)[1]
    offset = master.points[partner] - slave.points
    normal = slave.normal * np.sum(offset * slave.normal, axis=1)[:, None]
    return Match(
        partner,
        np.linalg.norm(offset - normal, axis=1),
        "along the surface to the nearest master node",
        _CURE[0].upper() + _CURE[1:],
    )


def along_direction(
    comm: MPI.Intracomm,
    slave: Surface,
    master: MasterNodes,
    direction: ArrayLike | Callable[[Vector], ArrayLike],
    tolerance: float,
    name: str,
) -> Match:
    """Match each slave node with the master node nearest to a line through it.

    Only master nodes whose normal points against the slave's are looked at, and of several sheets
    of the master that the line meets, the nearest one.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    slave, master : Surface, MasterNodes
        The surfaces.
    direction : (gdim,) array-like or callable
        The lines' direction, of either sense.
    tolerance : float
        How far from the line, relative to the size of the slave's facets.
    name : str
        Name of the contact.

    Returns
    -------
    Match
        The distance is across the direction.
    """
    gdim = slave.normal.shape[1]
    lines = unit_vectors(comm, direction, slave.coordinates, gdim, f"the direction of {name}")
    reach = tolerance * slave.size
    k = slave.nodes.size
    partner, distance = np.full(k, -1, dtype=np.int64), np.full(k, np.inf)
    leaves = _leaves(master.points)
    for first in range(0, k, _LINES):
        part = slice(first, min(first + _LINES, k))
        line, node, across, along = _near_lines(
            slave.points[part], lines[part], slave.normal[part], reach[part], master, leaves
        )
        closest = np.full(part.stop - first, np.inf)
        np.minimum.at(closest, line, along)
        sheet = along <= closest[line] + _SHEET * reach[part][line]
        line, node, across = line[sheet], node[sheet], across[sheet]
        order = np.lexsort((node, across, line))
        found, one = np.unique(line[order], return_index=True)
        partner[first + found], distance[first + found] = node[order][one], across[order][one]
    # how far the others missed is for messages only, which name few
    for row in _first_rows(slave.points, partner < 0):
        facing = master.normal @ slave.normal[row] < 0.0
        across = _to_lines(slave.points[[row]], lines[[row]], master.points[facing])[0]
        distance[row] = across.min(initial=np.inf)
    return Match(
        partner,
        distance,
        "across the direction to the nearest master node that faces the slave",
        f"Correct the direction, {_CURE}",
    )


def at_images(
    comm: MPI.Intracomm,
    slave: Surface,
    master: MasterNodes,
    mapping: Callable[[Vector], ArrayLike],
    name: str,
) -> Match:
    """Match each slave node x with the master node nearest to the user's chi(x)."""
    gdim = slave.normal.shape[1]
    images = vectors_at(comm, mapping, slave.coordinates, gdim, f"the mapping of {name}")
    distance, partner = _query(master.points, images)
    return Match(
        partner,
        distance,
        "from the mapped place to the nearest master node",
        f"Correct the mapping, {_CURE}",
    )


def by_coordinates(
    comm: MPI.Intracomm,
    slave: Surface,
    master: MasterNodes,
    pairs: tuple[ArrayLike, ArrayLike],
    tolerance: float,
    name: str,
) -> Match:
    """Match the nodes at the user's points.

    Raises
    ------
    InputError
        Wrong shapes, different pairs on different ranks, points that are no nodes of the surfaces,
        a slave node named twice.
    """
    gdim = slave.normal.shape[1]
    with raise_collectively(comm):
        slave_points, master_points = _given_pairs(pairs, gdim, name)
    _check_same_on_all_ranks(comm, slave_points, master_points, name)

    from_slave, at = _query(slave.points, slave_points)
    owner = _nearest_rank(comm, from_slave)
    mine = np.flatnonzero(owner == comm.rank)
    at, from_slave = at[mine], from_slave[mine]
    from_master, partner = _query(master.points, master_points[mine])
    size = (slave.size[at], master.size[partner])
    for side, distance, points, facet in (
        ("slave", from_slave, slave_points[mine], size[0]),
        ("master", from_master, master_points[mine], size[1]),
    ):
        _check_points_are_nodes(comm, distance, tolerance * facet, points, f"{name}: {side}")
    _check_named_once(comm, slave, at, name)

    match = Match(
        np.full(slave.nodes.size, -1, dtype=np.int64),
        np.full(slave.nodes.size, np.inf),
        "from the given points to the nodes",
        "Name them in pairs",
    )
    match.partner[at], match.distance[at] = partner, np.maximum(from_slave, from_master)
    return match


def _query(points: Vector, places: Vector) -> tuple[Vector, Numbers]:
    """Return the distance to, and the position of, the point nearest to each place.

    Of several equally near ones up to rounding it is the first.
    """
    if not len(points) or not len(places):
        return np.full(len(places), np.inf), np.zeros(len(places), dtype=np.int64)
    distances, at = cKDTree(points).query(places, k=range(1, min(_EQUALLY_NEAR, len(points)) + 1))
    tie = distances <= distances[:, :1] * (1.0 + _ROUNDING)
    first = np.argmin(np.where(tie, at, len(points)), axis=1)[:, None]
    distance, position = (np.take_along_axis(a, first, axis=1)[:, 0] for a in (distances, at))
    return distance, position.astype(np.int64)


def _leaves(points: Vector) -> list[Numbers]:
    """Split points into about as many compact groups as each of them has points."""
    if not len(points):
        return []

    def groups(branch: Any) -> Iterator[Numbers]:
        if branch.split_dim < 0:
            yield np.asarray(branch.indices, dtype=np.int64)
        else:
            yield from groups(branch.lesser)
            yield from groups(branch.greater)

    return list(groups(cKDTree(points, leafsize=max(8, isqrt(len(points)))).tree))


def _near_lines(
    points: Vector,
    lines: Vector,
    normal: Vector,
    reach: Vector,
    master: MasterNodes,
    leaves: list[Numbers],
) -> tuple[Numbers, Numbers, Vector, Vector]:
    """Return all (line, master node, distance across, distance along) within the lines' reach."""
    found: list[tuple[Any, ...]] = []
    for leaf in leaves:
        group = master.points[leaf]
        centre = 0.5 * (group.min(axis=0) + group.max(axis=0))
        radius = np.linalg.norm(group - centre, axis=1).max()
        rows = np.flatnonzero(_to_lines(points, lines, centre[None])[:, 0] <= reach + radius)
        across = _to_lines(points[rows], lines[rows], group)
        facing = normal[rows] @ master.normal[leaf].T < 0.0
        row, column = np.nonzero((across <= reach[rows, None]) & facing)
        line, node = rows[row], leaf[column]
        along = np.abs(np.sum((master.points[node] - points[line]) * lines[line], axis=1))
        found.append((line, node, across[row, column], along))
    nothing = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    line, node, across, along = (np.concatenate(c) for c in zip(nothing, *found, strict=True))
    return line, node, across, along


def _to_lines(points: Vector, lines: Vector, others: Vector) -> Vector:
    """Return the distance of each of the others from each line through a point: (k, m)."""
    offset = others[None, :, :] - points[:, None, :]
    along = np.einsum("kmd,kd->km", offset, lines)
    distance: Vector = np.linalg.norm(offset - along[..., None] * lines[:, None, :], axis=2)
    return distance


def _first_rows(points: Vector, chosen: NDArray[np.bool_], number: int = 3) -> Numbers:
    """Return the first of some points, by their coordinates."""
    rows = np.flatnonzero(chosen)
    first: Numbers = rows[np.lexsort(points[rows].T[::-1])[:number]]
    return first


def _given_pairs(pairs: Any, gdim: int, name: str) -> tuple[Vector, Vector]:
    try:
        slave, master = pairs
    except (TypeError, ValueError):
        raise InputError(f"{name}: pairs have to be (slave points, master points)") from None
    slave = points_of(slave, gdim, f"{name}: the slave points of pairs")
    master = points_of(master, gdim, f"{name}: the master points of pairs")
    if len(slave) != len(master):
        raise InputError(
            f"{name}: pairs have {len(slave)} slave points and {len(master)} master points; they "
            "belong together one by one"
        )
    return slave, master


def _check_same_on_all_ranks(
    comm: MPI.Intracomm, slave_points: Vector, master_points: Vector, name: str
) -> None:
    given = (slave_points, master_points)
    first = comm.bcast(given)
    same = all(np.array_equal(a, b) for a, b in zip(given, first, strict=True))
    if not comm.allreduce(same, MPI.LAND):
        raise InputError(f"{name}: pairs differ between ranks; give all of them to every rank")


def _nearest_rank(comm: MPI.Intracomm, distance: Vector) -> Numbers:
    """Return for each point the rank whose distance is smallest, the lowest of several."""
    smallest = np.empty_like(distance)
    comm.Allreduce(distance, smallest, MPI.MIN)
    candidate = np.where(distance == smallest, comm.rank, comm.size).astype(np.int64)
    owner = np.empty_like(candidate)
    comm.Allreduce(candidate, owner, MPI.MIN)
    return owner


def _check_points_are_nodes(
    comm: MPI.Intracomm, distance: Vector, limit: Vector, points: Vector, what: str
) -> None:
    far = distance > limit
    columns = (points[far], distance[far], limit[far])
    points, distance, limit = (concatenate_ranks(comm, column) for column in columns)
    if not len(points):
        return
    first = _first_rows(points, np.ones(len(points), dtype=bool))
    some = "; ".join(
        f"{format_point(points[k])} at distance {distance[k]:.3g} (tolerance {limit[k]:.3g})"
        for k in first
    )
    raise InputError(
        f"{what} points of {len(points)} pairs are no nodes of its surface: {some}. Distances are "
        "to the nearest node. Take the coordinates from the mesh, or raise the pair's tolerance"
    )


def _check_named_once(comm: MPI.Intracomm, slave: Surface, at: Numbers, name: str) -> None:
    node, counts = np.unique(at, return_counts=True)
    twice = concatenate_ranks(comm, slave.points[node[counts > 1]])
    if len(twice):
        first = _first_rows(twice, np.ones(len(twice), dtype=bool), 1)[0]
        raise InputError(
            f"{name}: {len(twice)} slave nodes are in several pairs, the first at "
            f"{format_point(twice[first], slave.extent)}: name each once"
        )
