"""Conditions between pairs of nodes, found by the mapping chi of sec. 11.1, and matching meshes."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    Accuracy,
    Conditions,
    JoinedPairs,
    Terms,
)
from fenics_tfeti.fem.contact.descriptions.partners import (
    Along,
    Mapped,
    Nearest,
    NodePartners,
    Points,
)
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, SurfaceNodes
from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.facets import apart
from fenics_tfeti.fem.geometry.normals import chord_heights
from fenics_tfeti.fem.geometry.vectors import angles_between, tangential_part, unit
from fenics_tfeti.fem.messages import coordinate_order, first_distances, first_wrong
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING, SAME_PLACE
from fenics_tfeti.fem.user_data import unit_vectors, vectors_at
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

_SEPARATE = (
    "The surfaces overlap or the bodies are one: each body needs nodes of its own. Bodies that "
    "share nodes, as Gmsh's fragment makes them, get their own by "
    "fenics_tfeti.io.split_interfaces. (Where two faces of one body meet, such as at the tip of a "
    "crack, partial=True leaves the shared nodes free)"
)

# angle between the normals of a slave and the opposite of its master's from which on both look the
# same way [degrees]
_SAME_WAY = 120.0

_REMEDY = "mesh the two surfaces alike, tag only where they face each other, or raise the tolerance"


def meshes_match(slave: Surface, master: SurfaceFacets, tolerance: float) -> Mask:
    """Tell of which contacts every facet of the slave has one of the master with the same nodes.

    Each of these nodes has one partner.
    Nodes are the same if they are opposite each other, along the normal of either surface or their
    mean, up to the rounding of coordinates in single precision. Gaps do not matter, as long as the
    distance along the slave's surface, relative to the size of its facets, is in the tolerance. The
    master is what is near this rank's slave nodes. Collective.
    """
    tree = cKDTree(apart(master.points, master.facets.contact_of(np.arange(len(master.points)))))
    partner = tree.query(apart(slave.points, slave.contact))[1]
    offset = master.points[partner] - slave.points
    opposite = unit(slave.normal - master.normal[partner])
    normals = (slave.normal, master.normal[partner], opposite)
    distances = [_distance_across(offset, normal) for normal in normals]
    tangential, distance = distances[0], np.min(distances, axis=0)
    near = (distance <= SAME_PLACE * slave.size) & (tangential <= tolerance * slave.size)
    near &= angles_between(slave.normal, -master.normal[partner]) <= _SAME_WAY
    # by global numbers: the corners of a facet may be other ranks', which have other parts of it
    corners = [master.nodes[master.facets.corners], slave.at_corners(master.nodes[partner])]
    facets = np.sort(np.concatenate(corners), axis=1)
    number = np.unique(facets, axis=0, return_inverse=True)[1].ravel()
    matching = np.isin(number[len(master.facets) :], number[: len(master.facets)])
    # two bodies of the slave beside each other have nodes opposite the same one of the master
    nodes, partner = slave.boundary.nodes, master.nodes[partner]
    number_of_slaves = nodes.reduce_at_owners(partner, near.astype(np.int64))
    is_only = nodes.values_at(number_of_slaves, partner) == 1
    match = np.ones(len(slave.extent), dtype=bool)
    match[slave.contact[~(near & is_only)]] = match[slave.facet_contact[~matching]] = False
    slave.comm.Allreduce(MPI.IN_PLACE, match, MPI.LAND)
    return match


def match_nodes(pairs: JoinedPairs, how: NodePartners) -> Conditions:
    """Return the conditions between pairs of nodes, this rank's part. Collective."""
    slave, master = pairs.slave, pairs.master.gathered_nodes()
    shared = shared_nodes(pairs, master.nodes)
    master = master.without(shared)

    partners = find_partners(how, slave, master)
    partners.distance[np.isin(slave.nodes, shared)] = np.inf
    limit = how.tolerance * slave.size
    _check_partners(pairs, partners, limit)
    paired = np.flatnonzero(partners.distance <= limit)
    partner, contact = partners.master[paired], slave.contact[paired]
    _check_one_to_one(pairs, master, partner)

    images = np.full_like(slave.points, np.nan)
    images[paired] = master.points[partner]
    at_corners = slave.at_corners(images)
    # at the tip of a crack facets are covered up to the shared nodes, which have no part of them
    has_partner = np.isfinite(at_corners).all(axis=2)
    is_shared = slave.at_corners(np.isin(slave.nodes, shared))
    covered = (has_partner | is_shared).all(axis=1)
    if pairs.contacts[0].normal is None:
        slave = slave.with_normals_of(covered)
    normal = slave.normal[paired]
    angle = angles_between(normal, -master.normal[partner])
    # a coarse mesh of a curved surface, or a normal that the user gave, may be off by a right angle
    if bad := slave.first_wrong(angle > _SAME_WAY, paired):
        raise InputError(
            f"{bad.name}: slave and master look the same way at {bad.number} nodes, the first at "
            f"{bad.place}: the outward normals of surfaces that touch point against each other. Is "
            "one of the tags on the far side of its body?"
        )
    _check_not_crossed(slave, at_corners)
    chords = chord_heights(slave.corners, slave.at_corners(slave.normal))[0]
    accuracy = Accuracy(
        # the nodes of both surfaces are on the curved one, up to their chords
        2.0 * slave.max_of_facets(chords)[paired],
        angle,
        np.bincount(contact, slave.area[paired], len(slave.names)),
        distance=slave.without_rounding(partners.distance[paired], contact),
    )
    return Conditions(
        Terms.of_nodes(slave.nodes[paired], master.nodes[partner]),
        normal,
        (images - slave.points)[paired],
        slave.areas(covered)[paired],
        (slave.share_of_area(covered) / slave.area)[paired],
        covered,
        lambda: accuracy,
    )


def shared_nodes(pairs: JoinedPairs, master: Numbers) -> Numbers:
    """Return the nodes on both surfaces, as partial contacts with others may have. Collective."""
    slave = pairs.slave
    is_shared = np.isin(slave.nodes, master)
    shared, total = slave.counts(slave.contact[is_shared], pairs.master.contact)
    may_share = pairs.partial & (shared < total)
    slave.check_separate(is_shared & ~may_share[slave.contact], _SEPARATE)
    if not shared.any():
        return np.zeros(0, dtype=np.int64)
    return concatenate_ranks(slave.comm, slave.nodes[is_shared])


@dataclass(frozen=True)
class Partners:
    """The partner of each slave node that this rank owns."""

    master: Numbers  # (k,): position among the master's nodes; -1 where there is none
    distance: Vector  # (k,): limited by the tolerance [m]; infinite where there is no partner
    measure: str  # how the distance is measured, for messages
    remedy: str  # what to do if it is too large


def find_partners(partners: NodePartners, slave: Surface, master: SurfaceNodes) -> Partners:
    """Find the partner of each slave node in the way that the user chose. Collective."""
    match partners:
        case Nearest():
            partner = _nearest_points(*(apart(s.points, s.contact) for s in (master, slave)))[1]
            distance = _distance_across(master.points[partner] - slave.points, slave.normal)
            measure = "along the surface to the nearest master node"
            return Partners(partner, distance, measure, _REMEDY[0].upper() + _REMEDY[1:])
        case Mapped(mapping):
            label, gdim = f"the mapping of {slave.names[0]}", slave.normal.shape[1]
            images = vectors_at(slave.comm, mapping, slave.coordinates, gdim, label)
            distance, partner = _nearest_points(master.points, images)
            measure = "from the mapped place to the nearest master node"
            return Partners(partner, distance, measure, f"Correct the mapping, {_REMEDY}")
        case Along():
            return _along(slave, master, partners)
        case Points():
            return _at_points(slave, master, partners)


def _along(slave: Surface, master: SurfaceNodes, along: Along) -> Partners:
    """Pair each slave node with the master node nearest to a line through it. Collective.

    Only master nodes whose normals point against the slave node's are candidates. If the line meets
    several sheets of the master's surface, only the nearest sheet counts. The distance is across
    the direction; the tolerance is relative to the size of the slave's facets.
    """
    gdim = slave.normal.shape[1]
    label, reach = f"the direction of {slave.names[0]}", along.tolerance * slave.size
    lines = unit_vectors(slave.comm, along.direction, slave.coordinates, gdim, label)
    row, node = _near_lines(slave.points, lines, reach, master.points)
    row, node = _chosen(np.sum(slave.normal[row] * master.normal[node], axis=1) < 0.0, row, node)
    offset = master.points[node] - slave.points[row]
    radial = _distance_across(offset, lines[row])
    axial = np.abs(np.sum(offset * lines[row], axis=1))
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
        radial = _distance_across(master.points[facing] - slave.points[k], lines[k])
        distance[k] = radial.min(initial=np.inf)
    return Partners(
        partner,
        distance,
        "across the direction to the nearest master node that faces the slave",
        f"Correct the direction, {_REMEDY}",
    )


def _at_points(slave: Surface, master: SurfaceNodes, pairs: Points) -> Partners:
    """Pair the nodes at the user's points, which are the same on all ranks. Collective."""
    comm, name, gdim = slave.comm, slave.names[0], slave.normal.shape[1]
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
    """Return the distance and position of the nearest points, of equally near ones the first."""
    # the centre of a hexahedron of a grid has eight nearest nodes
    candidates = min(8, len(points))
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
        distance = _distance_across(0.5 * (low + high) - x[row], lines[row])
        return distance <= reach[row] + 0.5 * np.linalg.norm(high - low, axis=1)

    return BoxTree(targets[:, None]).candidates(len(x), near)


def _distance_across(offset: Vector, lines: Vector) -> Vector:
    """Return the lengths (k,) of offsets (k, gdim) across unit vectors (k, gdim)."""
    return np.linalg.norm(tangential_part(offset, lines), axis=1)


def _chosen(mask: Mask, *columns: Array) -> list[Array]:
    return [column[mask] for column in columns]


def _check_partners(pairs: JoinedPairs, partners: Partners, limit: Vector) -> None:
    """Check that all slave nodes have a partner, or in a partial contact at least one."""
    slave, partial = pairs.slave, pairs.partial
    comm, far = slave.comm, partners.distance > limit
    missing, total = slave.counts(slave.contact[far], slave.contact)
    wrong = np.flatnonzero((missing > 0) & ~(partial & (missing < total)))
    if not wrong.size:
        return
    k = wrong[0]
    far &= slave.contact == k
    relative = partners.distance[far] / slave.size[far]
    largest = comm.allreduce(float(relative[np.isfinite(relative)].max(initial=0.0)), MPI.MAX)
    places = first_distances(
        comm, slave.points[far], partners.distance[far], limit[far], slave.extent[k]
    )
    measure = (
        f"Distances are {partners.measure}, up to {largest:.2g} of the facets' size. "
        if largest
        else ""
    )
    free = "" if partial[k] else ", or leave these nodes free by partial=True"
    raise InputError(
        f"{slave.names[k]}: {missing[k]} of {total[k]} slave nodes have no partner: {places}. "
        f"{measure}{partners.remedy}{free}"
    )


def _check_one_to_one(pairs: JoinedPairs, master: SurfaceNodes, partner: Numbers) -> None:
    """Check that no two slave nodes have the same partner, which are nodes of the master."""
    of_all = concatenate_ranks(pairs.slave.comm, partner)
    number = np.bincount(of_all, minlength=len(master.points))
    names = pairs.slave.names
    if bad := first_wrong(MPI.COMM_SELF, number > 1, master.points, master.contact, names):
        lower = "Lower the tolerance, so that some of them stay free; or exchange"
        raise InputError(
            f"{bad.name}: {bad.number} master nodes are each the partner of several slave nodes, "
            f"the first at {bad.place}; the mapping has to be one to one. "
            f"{lower if pairs.partial[bad.contact] else 'Exchange'} slave and master, or mesh the "
            "surfaces alike"
        )


def _check_not_crossed(slave: Surface, images: Vector) -> None:
    """Check that neighbouring slave nodes have their partners in the same order along the surface.

    The images (f, v, gdim) are the coordinates of the partners of the corners of this rank's
    facets, NaN where there is none.
    """
    v = images.shape[1]
    edges = np.array([(k, (k + 1) % v) for k in range(v if v > 2 else 1)])
    ends, normals, partners = (
        at_corners[:, edges]
        for at_corners in (slave.corners, slave.at_corners(slave.normal), images)
    )
    # tangential components only: gaps may differ from node to node
    normal = unit(normals.sum(axis=2))
    edge, image = (np.diff(part, axis=2)[:, :, 0] for part in (ends, partners))
    edge = tangential_part(edge, normal)
    product = np.linalg.norm(edge, axis=2) * np.linalg.norm(image, axis=2)
    # False where there is a NaN
    turned = np.sum(edge * tangential_part(image, normal), axis=2) < -RELATIVE_ROUNDING * product
    crossed = turned.any(axis=1)
    middles = slave.corners.mean(axis=1)
    if bad := first_wrong(slave.comm, crossed, middles, slave.facet_contact, slave.names):
        raise InputError(
            f"{bad.name}: pairs cross on {bad.number} facets of the slave, the first around "
            f"{bad.place}: neighbours there have partners that lie in the opposite order. Correct "
            "the points, mapping or direction, or lower the tolerance"
        )
