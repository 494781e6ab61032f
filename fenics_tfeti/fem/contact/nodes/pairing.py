"""Conditions between pairs of nodes, and whether two surface meshes match so that they suit."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.contact.checks import (
    check_facing,
    check_not_crossed,
    check_one_to_one,
    check_partners,
    check_separate,
)
from fenics_tfeti.fem.contact.contact import ContactPairing, Terms
from fenics_tfeti.fem.contact.description import ContactPair, NodePartners
from fenics_tfeti.fem.contact.nodes.search import find_partners
from fenics_tfeti.fem.contact.pairing_summary import angles_between, pairing_summary
from fenics_tfeti.fem.contact.surfaces.faceted import unit
from fenics_tfeti.fem.contact.surfaces.initial_gap import chord_heights, initial_gap
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.tolerances import SAME_PLACE
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Numbers

_SEPARATE = (
    "The surfaces overlap or the bodies are one: each body needs nodes of its own. Bodies that "
    "share nodes, as Gmsh's fragment makes them, get their own by "
    "fenics_tfeti.io.split_interfaces. (Where two faces of one body meet, such as at the tip of a "
    "crack, partial=True leaves the shared nodes free)"
)


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
    check_partners(slave, partners, limit, contact.partial, name)
    paired = partners.distance <= limit
    check_one_to_one(slave, master, partners, paired, contact.partial, name)

    partner_rows = partners.master[paired]
    angle = angles_between(slave.normal[paired], -master.normal[partner_rows])
    check_facing(slave, paired, angle, name)
    partner = master.points[partner_rows]
    images = np.full_like(slave.points, np.nan)
    images[paired] = partner
    images = slave.at_corners(images)
    check_not_crossed(slave, images, name)
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
    relative = distance / slave.size[paired]
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
            relative,
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
