"""Conditions between pairs of nodes, found by the mapping chi of sec. 11.1, and matching meshes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.contact.checks import check_separate
from fenics_tfeti.fem.contact.contact import ContactPairing, Terms
from fenics_tfeti.fem.contact.description import (
    Along,
    ContactPair,
    Mapped,
    Nearest,
    NodePartners,
    Points,
)
from fenics_tfeti.fem.contact.pairing_summary import angles_between, pairing_summary
from fenics_tfeti.fem.contact.surfaces.box_tree import BoxTree
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.contact.surfaces.initial_gap import chord_heights, initial_gap
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, SurfaceNodes
from fenics_tfeti.fem.messages import coordinate_order, first_distances, first_wrong
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.user_data import VectorField, unit_vectors, vectors_at
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

_SEPARATE = (
    "The surfaces overlap or the bodies are one: each body needs nodes of its own. Bodies that "
    "share nodes, as Gmsh's fragment makes them, get their own by "
    "fenics_tfeti.io.split_interfaces. (Where two faces of one body meet, such as at the tip of a "
    "crack, partial=True leaves the shared nodes free)"
)

_REMEDY = "mesh the two surfaces alike, tag only where they face each other, or raise the tolerance"


def meshes_match(slave: Surface, master: SurfaceFacets, tolerance: float) -> bool:
    """Tell whether every facet of the slave has one of the master with the same nodes. Collective.

    Nodes are the same if they are opposite each other, along the normal of either surface or their
    mean, up to the rounding of coordinates in single precision. Gaps do not matter, as long as the
    distance along the slave's surface, relative to the size of its facets, is in the tolerance. The
    master is what is near this rank's slave nodes.
    """
    distance, tangential = np.zeros((2, 0))
    partner = np.zeros(0, dtype=np.int64)
    if slave.nodes.size:
        partner = cKDTree(master.points).query(slave.points)[1]
        offset = master.points[partner] - slave.points
        opposite = unit(slave.normal - master.normal[partner])
        distances = [
            np.linalg.norm(tangential_part(offset, normal), axis=1)
            for normal in (slave.normal, master.normal[partner], opposite)
        ]
        tangential, distance = distances[0], np.min(distances, axis=0)
    near = (distance <= SAME_PLACE * slave.size) & (tangential <= tolerance * slave.size)
    if not slave.comm.allreduce(bool(near.all()), MPI.LAND):
        return False
    slave_facets = np.sort(slave.at_corners(partner), axis=1)
    facets = np.concatenate([np.sort(master.facets.corners, axis=1), slave_facets])
    number = np.unique(facets, axis=0, return_inverse=True)[1].ravel()
    matching = np.isin(number[len(master.facets) :], number[: len(master.facets)])
    return bool(slave.comm.allreduce(bool(matching.all()), MPI.LAND))


def match_nodes(
    name: str, contact: ContactPair, how: NodePartners, slave: Surface, tagged_master: Surface
) -> ContactPairing:
    """Return the conditions between pairs of nodes, this rank's part. Collective."""
    comm, master = slave.comm, tagged_master.gathered_nodes()
    shared = shared_nodes(name, slave, master.nodes, master.nodes.size, contact.partial)
    master = master.without(shared)

    partners = find_partners(how, slave, master, name)
    partners.distance[np.isin(slave.nodes, shared)] = np.inf
    limit = how.tolerance * slave.size
    _check_partners(slave, partners, limit, contact.partial, name)
    paired = partners.distance <= limit
    _check_one_to_one(slave, master, partners, paired, contact.partial, name)

    partner_rows = partners.master[paired]
    angle = angles_between(slave.normal[paired], -master.normal[partner_rows])
    # a coarse mesh of a curved surface, or a normal that the user gave, may be off by a right angle
    if bad := first_wrong(comm, angle > 120.0, slave.points[paired]):
        raise InputError(
            f"{name}: slave and master look the same way at {bad.number} nodes, the first at "
            f"{bad.place}: the outward normals of surfaces that touch point against each other. Is "
            "one of the tags on the far side of its body?"
        )
    partner = master.points[partner_rows]
    images = np.full_like(slave.points, np.nan)
    images[paired] = partner
    images = slave.at_corners(images)
    _check_not_crossed(slave, images, name)
    covered = np.isfinite(images).all(axis=(1, 2))
    area = slave.areas(covered, name)
    normal = slave.normal[paired]
    gap = slave.without_rounding(np.sum((partner - slave.points[paired]) * normal, axis=1))
    places = slave.coordinates[paired]
    chords = chord_heights(slave.corners, slave.at_corners(slave.normal))[0]
    # the nodes of both surfaces are on it, up to their chords
    chord = 2.0 * slave.max_of_facets(chords)[paired]
    gap = initial_gap(comm, contact.initial_gap, gap, chord, places, name)
    distance = slave.without_rounding(partners.distance[paired])
    return ContactPairing(
        Terms.of_nodes(slave.nodes[paired], master.nodes[partner_rows]),
        normal,
        gap,
        area[paired],
        name,
        pairing_summary(
            comm,
            name,
            "node_to_node",
            gap,
            angle,
            slave.nodes.size,
            distance,
            slave.size[paired],
            area[paired],
            float(slave.area[paired].sum()),
        ),
        slave,
        covered,
        coverage=(slave.share_of_area(covered) / slave.area)[paired],
        master_surface=tagged_master,
    )


def shared_nodes(name: str, slave: Surface, master: Numbers, number: int, partial: bool) -> Numbers:
    """Return the nodes, on all ranks, that are slave and master, such as the tip of a crack.

    `master` are the master's nodes that may be this rank's slave nodes, `number` is that of all.
    """
    shared = concatenate_ranks(slave.comm, slave.nodes[np.isin(slave.nodes, master)])
    if not partial or shared.size >= number:
        check_separate(slave, master, name, _SEPARATE)
    return shared


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
    slave: Surface, master: SurfaceNodes, direction: VectorField, tolerance: float, name: str
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
    slave: Surface, master: SurfaceNodes, mapping: Callable[[Vector], ArrayLike], name: str
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


def _check_partners(
    slave: Surface, partners: Partners, limit: Vector, partial: bool, name: str
) -> None:
    """Check that all slave nodes have a partner, or in a partial contact at least one."""
    comm, far = slave.comm, partners.distance > limit
    missing, total = comm.allreduce(int(far.sum())), comm.allreduce(far.size)
    if missing == 0 or (partial and missing < total):
        return
    relative = partners.distance[far] / slave.size[far]
    largest = comm.allreduce(float(relative[np.isfinite(relative)].max(initial=0.0)), MPI.MAX)
    places = first_distances(
        comm, slave.points[far], partners.distance[far], limit[far], slave.extent
    )
    measure = (
        f"Distances are {partners.measure}, up to {largest:.2g} of the facets' size. "
        if largest
        else ""
    )
    free = "" if partial else ", or leave these nodes free by partial=True"
    raise InputError(
        f"{name}: {missing} of {total} slave nodes have no partner: {places}. {measure}"
        f"{partners.remedy}{free}"
    )


def _check_one_to_one(
    slave: Surface, master: SurfaceNodes, partners: Partners, paired: Mask, partial: bool, name: str
) -> None:
    """Check that no two slave nodes have the same partner."""
    comm = slave.comm
    shared, counts = np.unique(concatenate_ranks(comm, partners.master[paired]), return_counts=True)
    shared = shared[counts > 1]
    if not shared.size:
        return
    concerned = paired & np.isin(partners.master, shared)
    relative = partners.distance[concerned] / slave.size[concerned]
    columns = (slave.points[concerned], partners.master[concerned], relative)
    points, partner, relative = (concatenate_ranks(comm, column) for column in columns)
    # a tolerance below the second smallest distance of a master node leaves one partner
    order = np.lexsort((relative, partner))
    second = order[1:][partner[order][1:] == partner[order][:-1]]
    # the master's nodes are in the order of their coordinates
    conflicting = points[partner == shared[0]]
    places = " and ".join(
        format_point(point, slave.extent) for point in conflicting[coordinate_order(conflicting)]
    )
    remedy = (
        "Exchange slave and master, or mesh the surfaces alike"
        if not partial
        else f"With a tolerance below {relative[second].min():.2g} some of them stay free; or "
        "exchange slave and master, or mesh the surfaces alike"
    )
    raise InputError(
        f"{name}: {shared.size} master nodes are each the partner of several slave nodes, the "
        f"first at {format_point(master.points[shared[0]], slave.extent)} of those at {places}; "
        f"the mapping has to be one to one. {remedy}"
    )


def _check_not_crossed(slave: Surface, images: Vector, name: str) -> None:
    """Check that neighbouring slave nodes have their partners in the same order along the surface.

    The images (f, v, gdim) are the coordinates of the partners of the corners of this rank's
    facets, NaN where there is none.
    """
    corners, normals = slave.corners, slave.at_corners(slave.normal)
    v, gdim = images.shape[1:]
    edges = np.array([(k, (k + 1) % v) for k in range(v if v > 2 else 1)])
    ends, ends_normals, partners = (
        corner_values[:, edges].reshape(-1, 2, gdim) for corner_values in (corners, normals, images)
    )
    normal = unit(ends_normals.sum(axis=1))
    # tangential components only: gaps may differ from node to node
    edge = tangential_part(ends[:, 1] - ends[:, 0], normal)
    image = partners[:, 1] - partners[:, 0]
    product = np.linalg.norm(edge, axis=1) * np.linalg.norm(image, axis=1)
    image = tangential_part(image, normal)
    # False where there is a NaN
    crossed = np.sum(edge * image, axis=1) < -RELATIVE_ROUNDING * product

    crossings = np.concatenate([ends[crossed], partners[crossed]], axis=1)
    # an edge belongs to two facets: it is listed from its smaller end, and once
    swap = np.array([b < a for a, b in crossings[:, :2].tolist()], dtype=bool)
    crossings[swap] = crossings[swap][:, [1, 0, 3, 2]]
    crossings = np.unique(concatenate_ranks(slave.comm, crossings.reshape(-1, 4 * gdim)), axis=0)
    if not len(crossings):
        return
    a, b, partner_a, partner_b = (
        format_point(p, slave.extent) for p in crossings[0].reshape(4, gdim)
    )
    raise InputError(
        f"{name}: pairs cross on {len(crossings)} edges of slave facets: the neighbours {a} and "
        f"{b} have the partners {partner_a} and {partner_b}, which lie in the opposite order. "
        "Correct the points, mapping or direction, or lower the tolerance"
    )
