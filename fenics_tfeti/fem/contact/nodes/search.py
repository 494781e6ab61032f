"""The search for partners: the mapping chi of sec. 11.1, from slave nodes to master nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.description import Along, Mapped, Nearest, NodePartners, Points
from fenics_tfeti.fem.contact.surfaces.box_tree import BoxTree
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, SurfaceNodes
from fenics_tfeti.fem.messages import coordinate_order, first_distances, first_wrong
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import VectorField, unit_vectors, vectors_at
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

_REMEDY = "mesh the two surfaces alike, tag only where they face each other, or raise the tolerance"


@dataclass(frozen=True)
class Partners:
    """The partner of each slave node that this rank owns."""

    master: Numbers  # (k,): position among the master's nodes; -1 where there is none
    distance: Vector  # (k,): limited by the tolerance [m]; infinite where there is no partner
    measure: str  # how the distance is measured, for messages
    remedy: str  # what to do if it is too large


def find_partners(
    partners: NodePartners, slave: Surface, master: SurfaceNodes, name: str
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


def _nearest(slave: Surface, master: SurfaceNodes) -> Partners:
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
    master: SurfaceNodes,
    direction: VectorField,
    tolerance: float,
    name: str,
) -> Partners:
    """Pair each slave node with the master node nearest to a line through it. Collective.

    Only master nodes whose normals point against the slave node's are candidates. If the line meets
    several sheets of the master's surface, only the nearest sheet counts. The distance is across
    the direction; the tolerance is relative to the size of the slave's facets.
    """
    gdim = slave.normal.shape[1]
    lines = unit_vectors(slave.comm, direction, slave.coordinates, gdim, f"the direction of {name}")
    reach = tolerance * slave.size
    row, node = _near_lines(slave.points, lines, reach, master.points)
    row, node = _chosen(np.sum(slave.normal[row] * master.normal[node], axis=1) < 0.0, row, node)
    offset = master.points[node] - slave.points[row]
    radial, axial = (
        _distance_to_lines(offset, lines[row]),
        np.abs(np.sum(offset * lines[row], axis=1)),
    )
    row, node, radial, axial = _chosen(radial <= reach[row], row, node, radial, axial)
    closest = np.full(reach.size, np.inf)
    np.minimum.at(closest, row, axial)
    # on a sheet inclined by up to 60 degrees, nodes within the reach of a line are at most four
    # times the reach apart along it
    on_sheet = axial <= closest[row] + 4.0 * reach[row]
    row, node, radial = _chosen(on_sheet, row, node, radial)
    order = np.lexsort((node, radial, row))
    reached, best = np.unique(row[order], return_index=True)
    partner, distance = np.full(reach.size, -1, dtype=np.int64), np.full(reach.size, np.inf)
    partner[reached], distance[reached] = node[order][best], radial[order][best]
    # the distances of the others are for a message only, which names a few nodes
    alone = np.flatnonzero(partner < 0)
    for k in alone[coordinate_order(slave.points[alone])[:3]]:
        facing = master.normal @ slave.normal[k] < 0.0
        radial = _distance_to_lines(master.points[facing] - slave.points[k], lines[k])
        distance[k] = radial.min(initial=np.inf)
    return Partners(
        partner,
        distance,
        "across the direction to the nearest master node that faces the slave",
        f"Correct the direction, {_REMEDY}",
    )


def _mapped(
    slave: Surface,
    master: SurfaceNodes,
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


def _at_points(slave: Surface, master: SurfaceNodes, pairs: Points, name: str) -> Partners:
    """Pair the nodes at the user's points, which are the same on all ranks. Collective."""
    comm, gdim = slave.comm, slave.normal.shape[1]
    slave_points, master_points = (
        np.asarray(points, dtype=float)[:, :gdim] for points in (pairs.slave, pairs.master)
    )
    with raise_collectively(comm):
        if min(slave_points.shape[1], master_points.shape[1]) < gdim:
            raise InputError(f"{name}: points have two coordinates, those of the mesh have {gdim}")
    first = comm.bcast((slave_points, master_points))
    same = all(map(np.array_equal, (slave_points, master_points), first))
    if not comm.allreduce(same, MPI.LAND):
        raise InputError(f"{name}: points differ between ranks; give all of them to every rank")
    nodes = slave.gathered_nodes()
    slave_distance, rows = _nearest_points(nodes.points, slave_points)
    master_distance, partner = _nearest_points(master.points, master_points)
    for side, distance, points, size in (
        ("slave", slave_distance, slave_points, nodes.size[rows]),
        ("master", master_distance, master_points, master.size[partner]),
    ):
        limit = pairs.tolerance * size
        far = distance > limit
        if far.any():
            places = first_distances(MPI.COMM_SELF, points[far], distance[far], limit[far])
            raise InputError(
                f"{name}: {side} points of {far.sum()} pairs are not nodes of its surface: "
                f"{places}. Distances are to the nearest node. Take the coordinates from the mesh, "
                "or raise the tolerance"
            )
    if bad := first_wrong(
        MPI.COMM_SELF, np.bincount(rows, minlength=len(nodes.points)) > 1, nodes.points
    ):
        raise InputError(
            f"{name}: {bad.number} slave nodes are in several pairs, the first at {bad.place}: "
            "name each once"
        )
    partners = Partners(
        np.full(slave.nodes.size, -1, dtype=np.int64),
        np.full(slave.nodes.size, np.inf),
        "from the given points to the nodes",
        "Name them among the points",
    )
    _, own, pair = np.intersect1d(slave.nodes, nodes.nodes[rows], return_indices=True)
    partners.master[own] = partner[pair]
    partners.distance[own] = np.maximum(slave_distance, master_distance)[pair]
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


def _near_lines(
    x: Vector, lines: Vector, reach: Vector, targets: Vector
) -> tuple[Numbers, Numbers]:
    """Find pairs of a line through x (k, gdim) and a target that may be within its reach."""

    def near(row: Numbers, low: Vector, high: Vector) -> Mask:
        distance = _distance_to_lines(0.5 * (low + high) - x[row], lines[row])
        is_near: Mask = distance <= reach[row] + 0.5 * np.linalg.norm(high - low, axis=1)
        return is_near

    return BoxTree(targets[:, None]).candidates(len(x), near)


def _distance_to_lines(offset: Vector, lines: Vector) -> Vector:
    """Return the lengths (k,) of offsets (k, gdim) across unit vectors (k, gdim)."""
    axial = np.sum(offset * lines, axis=1, keepdims=True)
    distance: Vector = np.linalg.norm(offset - axial * lines, axis=1)
    return distance


def _chosen(mask: Mask, *columns: Array) -> list[Array]:
    return [column[mask] for column in columns]
