"""The search for partners: the mapping chi of sec. 11.1, from slave nodes to master nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import isqrt
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.description import Along, Mapped, Nearest, NodePartners, Points
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.tagged import MasterNodes, Surface
from fenics_tfeti.fem.messages import coordinate_order, first_distances, raise_where
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import VectorField, unit_vectors, vectors_at
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector

_REMEDY = "mesh the two surfaces alike, tag only where they face each other, or raise the tolerance"


@dataclass(frozen=True)
class Partners:
    """The partner of each slave node that this rank owns."""

    master: Numbers  # (k,): position among the master's nodes; -1 where there is none
    distance: Vector  # (k,): limited by the tolerance [m]; infinite where there is no partner
    measure: str  # how the distance is measured, for messages
    remedy: str  # what to do if it is too large


def find_partners(
    partners: NodePartners, slave: Surface, master: MasterNodes, name: str
) -> Partners:
    """Find the partner of each slave node in the way that the user chose. Collective."""
    match partners:
        case Nearest():
            return _nearest(slave, master)
        case Along(direction, tolerance):
            return _along(slave, master, direction, tolerance, name)
        case Mapped(mapping):
            return _mapped(slave, master, mapping, name)
        case Points():
            return _at_points(slave, master, partners, name)


def _nearest(slave: Surface, master: MasterNodes) -> Partners:
    """Pair each slave node with the nearest master node; the distance is along the surface."""
    partner = _nearest_points(master.points, slave.points)[1]
    offset = master.points[partner] - slave.points
    return Partners(
        partner,
        np.linalg.norm(tangential_part(offset, slave.normal), axis=1),
        "along the surface to the nearest master node",
        _REMEDY[0].upper() + _REMEDY[1:],
    )


def _along(
    slave: Surface,
    master: MasterNodes,
    direction: VectorField,
    tolerance: float,
    name: str,
) -> Partners:
    """Pair each slave node with the master node nearest to a line through it. Collective.

    Only master nodes whose normals point against the slave node's are candidates. If the line meets
    several sheets of the master's surface, only the nearest sheet counts. The distance is across
    the direction; the tolerance is relative to the size of the slave's facets.
    """
    lines_at_once = 4096  # bounds the memory
    gdim = slave.normal.shape[1]
    lines = unit_vectors(slave.comm, direction, slave.coordinates, gdim, f"the direction of {name}")
    reach = tolerance * slave.size
    k = slave.nodes.size
    partner, distance = np.full(k, -1, dtype=np.int64), np.full(k, np.inf)
    groups = _compact_groups(master.points)
    for first in range(0, k, lines_at_once):
        part = slice(first, min(first + lines_at_once, k))
        line, node, radial, axial = _near_lines(
            slave.points[part], lines[part], slave.normal[part], reach[part], master, groups
        )
        on_sheet = _on_nearest_sheet(line, axial, reach[part])
        line, node, radial = line[on_sheet], node[on_sheet], radial[on_sheet]
        order = np.lexsort((node, radial, line))
        reached, best = np.unique(line[order], return_index=True)
        partner[first + reached], distance[first + reached] = node[order][best], radial[order][best]
    # the distances of the others are for a message only, which names a few nodes
    alone = np.flatnonzero(partner < 0)
    for row in alone[coordinate_order(slave.points[alone])[:3]]:
        facing = master.normal @ slave.normal[row] < 0.0
        radial = _distance_to_lines(slave.points[[row]], lines[[row]], master.points[facing])[0]
        distance[row] = radial.min(initial=np.inf)
    return Partners(
        partner,
        distance,
        "across the direction to the nearest master node that faces the slave",
        f"Correct the direction, {_REMEDY}",
    )


def _mapped(
    slave: Surface,
    master: MasterNodes,
    mapping: Callable[[Vector], ArrayLike],
    name: str,
) -> Partners:
    """Pair each slave node x with the master node nearest to the user's chi(x). Collective."""
    gdim = slave.normal.shape[1]
    images = vectors_at(slave.comm, mapping, slave.coordinates, gdim, f"the mapping of {name}")
    distance, partner = _nearest_points(master.points, images)
    return Partners(
        partner,
        distance,
        "from the mapped place to the nearest master node",
        f"Correct the mapping, {_REMEDY}",
    )


def _at_points(slave: Surface, master: MasterNodes, pairs: Points, name: str) -> Partners:
    """Pair the nodes at the user's points, which are the same on all ranks. Collective."""
    comm, gdim = slave.comm, slave.normal.shape[1]
    with raise_collectively(comm):
        slave_points, master_points = _point_arrays(pairs, gdim, name)
    _check_same_on_all_ranks(comm, slave_points, master_points, name)

    slave_distance, rows = _nearest_points(slave.points, slave_points)
    owner = _nearest_rank(comm, slave_distance)
    local = np.flatnonzero(owner == comm.rank)
    rows, slave_distance = rows[local], slave_distance[local]
    master_distance, partner = _nearest_points(master.points, master_points[local])
    for side, distance, points, size in (
        ("slave", slave_distance, slave_points[local], slave.size[rows]),
        ("master", master_distance, master_points[local], master.size[partner]),
    ):
        _check_points_are_nodes(comm, distance, pairs.tolerance * size, points, f"{name}: {side}")
    _check_named_once(slave, rows, name)

    partners = Partners(
        np.full(slave.nodes.size, -1, dtype=np.int64),
        np.full(slave.nodes.size, np.inf),
        "from the given points to the nodes",
        "Name them among the points",
    )
    partners.master[rows], partners.distance[rows] = (
        partner,
        np.maximum(slave_distance, master_distance),
    )
    return partners


def _nearest_points(points: Vector, places: Vector) -> tuple[Vector, Numbers]:
    """Return for each place the distance to the nearest point, and the position of that point.

    Of points that are equally near up to rounding, the one with the lowest position is taken.
    """
    # the centre of a hexahedron of a grid has eight nearest nodes
    candidates = min(8, len(points))
    if not len(points) or not len(places):
        return np.full(len(places), np.inf), np.zeros(len(places), dtype=np.int64)
    distances, positions = cKDTree(points).query(places, k=range(1, candidates + 1))
    tie = distances <= distances[:, :1] * (1.0 + RELATIVE_ROUNDING)
    first = np.argmin(np.where(tie, positions, len(points)), axis=1)[:, None]
    distance, position = (
        np.take_along_axis(a, first, axis=1)[:, 0] for a in (distances, positions)
    )
    return distance, position.astype(np.int64)


def _compact_groups(points: Vector) -> list[Numbers]:
    """Split points into compact groups, about as many as each has points, by a k-d tree."""
    if not len(points):
        return []

    def leaves(branch: Any) -> Iterator[Numbers]:
        if branch.split_dim < 0:
            yield np.asarray(branch.indices, dtype=np.int64)
        else:
            yield from leaves(branch.lesser)
            yield from leaves(branch.greater)

    return list(leaves(cKDTree(points, leafsize=max(8, isqrt(len(points)))).tree))


def _near_lines(
    points: Vector,
    lines: Vector,
    normal: Vector,
    reach: Vector,
    master: MasterNodes,
    groups: list[Numbers],
) -> tuple[Numbers, Numbers, Vector, Vector]:
    """Find all master nodes near lines through points, whose normals point against those there.

    Returned are pairs (n,) of a line and a master node no farther from it than its `reach`, and the
    distances across and along the line [m].
    """
    parts: list[tuple[Any, ...]] = []
    for group in groups:
        members = master.points[group]
        centre = 0.5 * (members.min(axis=0) + members.max(axis=0))
        radius = np.linalg.norm(members - centre, axis=1).max()
        centre_distance = _distance_to_lines(points, lines, centre[None])[:, 0]
        rows = np.flatnonzero(centre_distance <= reach + radius)
        radial = _distance_to_lines(points[rows], lines[rows], members)
        facing = normal[rows] @ master.normal[group].T < 0.0
        row, column = np.nonzero((radial <= reach[rows, None]) & facing)
        line, node = rows[row], group[column]
        axial = np.abs(np.sum((master.points[node] - points[line]) * lines[line], axis=1))
        parts.append((line, node, radial[row, column], axial))
    nothing = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0)
    line, node, radial, axial = (np.concatenate(c) for c in zip(nothing, *parts, strict=True))
    return line, node, radial, axial


def _on_nearest_sheet(line: Numbers, axial: Vector, reach: Vector) -> NDArray[np.bool_]:
    """Tell which candidates are on the sheet of the master's surface that is nearest along a line.

    On a sheet inclined by up to 60 degrees, nodes within the reach of a line are at most four times
    the reach apart along it.
    """
    closest = np.full(reach.size, np.inf)
    np.minimum.at(closest, line, axial)
    on_sheet: NDArray[np.bool_] = axial <= closest[line] + 4.0 * reach[line]
    return on_sheet


def _distance_to_lines(points: Vector, lines: Vector, targets: Vector) -> Vector:
    """Return the distance (k, m) of each of the others from each line through a point."""
    offset = targets[None, :, :] - points[:, None, :]
    axial = np.einsum("kmd,kd->km", offset, lines)
    distance: Vector = np.linalg.norm(offset - axial[..., None] * lines[:, None, :], axis=2)
    return distance


def _point_arrays(pairs: Points, gdim: int, name: str) -> tuple[Vector, Vector]:
    """Return the points of slave and master (k, gdim)."""
    slave, master = (np.asarray(points, dtype=float) for points in (pairs.slave, pairs.master))
    if min(slave.shape[1], master.shape[1]) < gdim:
        raise InputError(f"{name}: points have two coordinates, those of the mesh have {gdim}")
    return slave[:, :gdim], master[:, :gdim]


def _check_same_on_all_ranks(
    comm: MPI.Intracomm, slave_points: Vector, master_points: Vector, name: str
) -> None:
    local = (slave_points, master_points)
    first = comm.bcast(local)
    same = all(np.array_equal(a, b) for a, b in zip(local, first, strict=True))
    if not comm.allreduce(same, MPI.LAND):
        raise InputError(f"{name}: points differ between ranks; give all of them to every rank")


def _nearest_rank(comm: MPI.Intracomm, distance: Vector) -> Numbers:
    """Return for each point the lowest of the ranks with the smallest distance."""
    smallest = np.empty_like(distance)
    comm.Allreduce(distance, smallest, MPI.MIN)
    candidate = np.where(distance == smallest, comm.rank, comm.size).astype(np.int64)
    owner = np.empty_like(candidate)
    comm.Allreduce(candidate, owner, MPI.MIN)
    return owner


def _check_points_are_nodes(
    comm: MPI.Intracomm, distance: Vector, limit: Vector, points: Vector, label: str
) -> None:
    far = distance > limit
    number = comm.allreduce(int(far.sum()))
    if not number:
        return
    places = first_distances(comm, points[far], distance[far], limit[far])
    raise InputError(
        f"{label} points of {number} pairs are not nodes of its surface: {places}. Distances are "
        "to the nearest node. Take the coordinates from the mesh, or raise the tolerance"
    )


def _check_named_once(slave: Surface, rows: Numbers, name: str) -> None:
    raise_where(
        slave.comm,
        np.bincount(rows, minlength=slave.nodes.size) > 1,
        slave.points,
        lambda number, place: (
            f"{name}: {number} slave nodes are in several pairs, the first at {place}: name each "
            "once"
        ),
    )
