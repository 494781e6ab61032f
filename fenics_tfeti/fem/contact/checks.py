"""Checks of contacts: the pairs that were found, and contacts that overlap.

What concerns one pair of points or one surface alone is checked where it is read, in `search` and
`surfaces`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from mpi4py import MPI

import numpy as np

from dolfinx.fem import FunctionSpace

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.description import Contact, ContactPair
from fenics_tfeti.fem.contact.nodes.search import Partners
from fenics_tfeti.fem.contact.pairing_summary import angles_between
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, SurfaceNodes
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.messages import coordinate_order, first_distances, first_wrong
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.topology import cell_vertices
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector

# -- the pairs of one contact ------------------------------------------------------------------


def check_separate(slave: Surface, master: Numbers, name: str, remedy: str) -> None:
    """Check that none of a slave's nodes, at its vertices, is one of the master. Collective."""
    if bad := first_wrong(slave.comm, np.isin(slave.nodes, master), slave.points):
        raise InputError(
            f"{name}: slave and master share {bad.number} nodes, the first at {bad.place}. {remedy}"
        )


def check_partners(
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


def check_one_to_one(
    slave: Surface,
    master: SurfaceNodes,
    partners: Partners,
    paired: Mask,
    partial: bool,
    name: str,
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


def check_facing(slave: Surface, paired: Mask, angle: Vector, name: str) -> None:
    """Check that the slave's normals point against those of the partners, angles in degrees."""
    # a coarse mesh of a curved surface, or a normal that the user gave, may be off by a right angle
    if bad := first_wrong(slave.comm, angle > 120.0, slave.points[paired]):
        raise InputError(
            f"{name}: slave and master look the same way at {bad.number} nodes, the first at "
            f"{bad.place}: the outward normals of surfaces that touch point against each other. Is "
            "one of the tags on the far side of its body?"
        )


def check_not_crossed(slave: Surface, images: Vector, name: str) -> None:
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
    swap = _comes_before(crossings[:, 1], crossings[:, 0])
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


def _comes_before(first: Vector, second: Vector) -> Mask:
    """Compare points row by row, by their first different coordinate."""
    different = first != second
    column = np.argmax(different, axis=1)
    rows = np.arange(len(first))
    smaller: Mask = first[rows, column] < second[rows, column]
    return smaller


# -- several contacts --------------------------------------------------------------------------


def check_different_surfaces(contacts: Sequence[Contact], comm: MPI.Intracomm) -> None:
    """Check that no two pairs join the same two surfaces, in either role."""
    pairs: dict[tuple[int, frozenset[int]], int] = {}
    with raise_collectively(comm):
        for number, contact in enumerate(contacts):
            if not isinstance(contact, ContactPair):
                continue
            tags = frozenset((contact.slave, contact.master))
            key = (id(_compat.cpp_object(contact.facet_tags)), tags)
            if key in pairs:
                raise InputError(
                    f"contacts {pairs[key]} and {number} join the same two surfaces, with slave "
                    f"and master {sorted(tags)}: keep one of them"
                )
            pairs[key] = number


def check_depth(space: FunctionSpace, bodies: Bodies, pairings: Sequence[ContactPairing]) -> None:
    """Check that no slave node is deeper in its master than either body is thick. Collective.

    So deep are surfaces that lie back to back, each on the far side of its body. The thickness is
    that of the body's bounding box along the normal.
    """
    comm = space.mesh.comm
    inside = [(pairing.master >= 0) & (pairing.gap < 0.0) for pairing in pairings]
    if not comm.allreduce(sum(int(mask.sum()) for mask in inside)):
        return
    size = _sizes_of_bodies(space, bodies)
    cells = _compat.cell_dofs(space)[: bodies.of_cell.size]
    nodes = NodeMap(space)
    body = np.zeros(nodes.size, dtype=np.int64)
    body[cells] = bodies.of_cell[:, None]
    in_cells = np.unique(cells)
    body_of_node = nodes.sum_at_owners(nodes.to_global(in_cells), body[in_cells], np.maximum)
    for pairing, mask in zip(pairings, inside, strict=True):
        normal = np.abs(pairing.normal[mask])
        ends = (pairing.slave[mask], pairing.master[mask])
        thickness = [
            np.sum(normal * size[nodes.values_at(body_of_node, end)], axis=1) for end in ends
        ]
        _raise_too_deep(comm, pairing, mask, np.minimum(*thickness))


def _sizes_of_bodies(space: FunctionSpace, bodies: Bodies) -> Vector:
    """Return the edges of the bodies' bounding boxes, (bodies, gdim)."""
    comm, gdim = space.mesh.comm, space.mesh.geometry.dim
    cells = cell_vertices(space.mesh)[: bodies.of_cell.size]
    corners = space.mesh.geometry.x[cells, :gdim]
    low = np.full((len(bodies.names), gdim), np.inf)
    high = -low
    np.minimum.at(low, bodies.of_cell, corners.min(axis=1, initial=np.inf))
    np.maximum.at(high, bodies.of_cell, corners.max(axis=1, initial=-np.inf))
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    size: Vector = high - low
    return size


def _raise_too_deep(
    comm: MPI.Intracomm, pairing: ContactPairing, inside: Mask, thickness: Vector
) -> None:
    gap = pairing.gap[inside]
    deepest = comm.allreduce(float((-gap).max(initial=0.0)), MPI.MAX)
    if bad := first_wrong(
        comm, -gap > thickness, pairing.coordinates[inside, : pairing.normal.shape[1]]
    ):
        raise InputError(
            f"{pairing.name}: {bad.number} slave nodes are deeper in the master than one of the "
            f"bodies is thick, by up to {deepest:.3g}, the first at {bad.place}. Surfaces that "
            "touch face each other: is one of the tags on the far side of its body?"
        )


def check_different_nodes(
    contacts: Sequence[Contact], pairings: Sequence[ContactPairing], comm: MPI.Intracomm
) -> None:
    """Check that no slave node is in two contacts with the same master surface or obstacle."""
    of_master: dict[tuple[int, int], list[ContactPairing]] = {}
    for contact, pairing in zip(contacts, pairings, strict=True):
        of_master.setdefault(_master_key(contact), []).append(pairing)
    for several in of_master.values():
        for a, b in combinations(several, 2):
            _check_common_nodes(comm, a, b)


def _check_common_nodes(comm: MPI.Intracomm, a: ContactPairing, b: ContactPairing) -> None:
    _, rows_a, rows_b = np.intersect1d(a.slave, b.slave, return_indices=True)
    # at an edge of the body a node has two conditions, with normals farther apart than this angle
    edge_angle = 45.0
    if bad := first_wrong(
        comm,
        angles_between(a.normal[rows_a], b.normal[rows_b]) < edge_angle,
        a.coordinates[rows_a, : a.normal.shape[1]],
    ):
        raise InputError(
            f"{a.name} and {b.name} match {bad.number} slave nodes twice with the same master "
            f"surface or obstacle, the first at {bad.place}: join the two slave surfaces under one "
            "tag, or separate them"
        )


def _master_key(contact: Contact) -> tuple[int, int]:
    """Return what tells the master's surface or the obstacle apart from others."""
    if isinstance(contact, ContactPair):
        return id(_compat.cpp_object(contact.facet_tags)), contact.master
    return id(contact.obstacle), 0
