"""Contact conditions of tagged surfaces, with normals and gaps (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.checks import (
    check_different_nodes,
    check_different_surfaces,
    check_facing,
    check_not_crossed,
    check_one_to_one,
    check_partners,
    check_shared_nodes,
)
from fenics_tfeti.fem.contact.contact import ContactPairing, Terms
from fenics_tfeti.fem.contact.description import (
    Contact,
    ContactPair,
    Nearest,
    NodePartners,
    RigidObstacle,
    contact_name,
)
from fenics_tfeti.fem.contact.mortar.pairing import match_by_mortar
from fenics_tfeti.fem.contact.nodes.matching_meshes import meshes_match
from fenics_tfeti.fem.contact.nodes.search import find_partners
from fenics_tfeti.fem.contact.obstacle_conditions import match_obstacle
from fenics_tfeti.fem.contact.pairing_summary import angles_between, pairing_summary
from fenics_tfeti.fem.contact.surfaces.cylinders import without_axial_tilt
from fenics_tfeti.fem.contact.surfaces.initial_gap import chord_heights, initial_gap
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.node_areas import node_areas
from fenics_tfeti.fem.contact.surfaces.symmetry_planes import prescribed_components, same_supports
from fenics_tfeti.fem.contact.surfaces.tagged import (
    MeshBoundary,
    Surface,
    gather_master,
    tagged_surface,
)
from fenics_tfeti.feti.system import ContactRows, Prescribed
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


def match_contacts(
    boundary: MeshBoundary,
    contacts: Sequence[Contact],
    known: Sequence[tuple[Contact, ContactPairing]] = (),
    prescribed: Prescribed | None = None,
    numbers: Sequence[int] | None = None,
) -> list[ContactPairing]:
    """Match the surfaces of all contacts, and check that no two contacts overlap. Collective.

    Of the known results, pairs are not searched again, obstacles are evaluated again. Prescribed
    displacements of this rank's nodes tell planes of symmetry. The numbers are those of contacts
    without a name.
    """
    comm = boundary.space.mesh.comm
    check_different_surfaces(contacts, comm)
    earlier = {id(contact): pairing for contact, pairing in known}
    pairings = [
        match_contact(boundary, contact, i, earlier.get(id(contact)), prescribed)
        for i, contact in zip(numbers or range(len(contacts)), contacts, strict=True)
    ]
    check_different_nodes(contacts, pairings, comm)
    return pairings


def match_contact(
    boundary: MeshBoundary,
    contact: Contact,
    number: int,
    earlier: ContactPairing | None = None,
    prescribed: Prescribed | None = None,
) -> ContactPairing:
    """Find the slave's nodes, normals, partners and gaps, this rank's part. Collective.

    The master's nodes are gathered on all ranks, of its facets those near each rank's slave facets.
    Of an earlier result, pairs of nodes are used again but for areas with a weight, which may have
    changed; mortar conditions if they have no weight and the same components are prescribed; of an
    obstacle's the surface.
    """
    name = contact_name(contact, number)
    if isinstance(contact, RigidObstacle):
        return match_obstacle(boundary, name, contact, earlier)
    supports = Prescribed() if prescribed is None else prescribed
    if earlier is None or not _still_holds(boundary, earlier, supports):
        pairing = _match_pair(boundary, name, contact, supports)
        if contact.normal is not None:
            return pairing
        normal = without_axial_tilt(pairing.surface, pairing.slave, pairing.normal)
        return replace(pairing, normal=normal)
    gap = _updated_gap(boundary.space.mesh.comm, contact, earlier)
    if boundary.weight is None:
        return earlier if gap is earlier.gap else replace(earlier, gap=gap)
    surface = earlier.surface
    area = node_areas(surface, earlier.covered, name)
    return replace(earlier, gap=gap, area=area[earlier.on_surface])


def _still_holds(boundary: MeshBoundary, earlier: ContactPairing, prescribed: Prescribed) -> bool:
    """Tell whether the conditions of a pair found earlier hold with these supports. Collective."""
    if earlier.prescribed is None:
        return True
    if boundary.weight is not None:
        return False
    return same_supports(boundary.space.mesh.comm, earlier.surface, prescribed, earlier.prescribed)


def _updated_gap(comm: MPI.Intracomm, contact: ContactPair, earlier: ContactPairing) -> Vector:
    """Return the gaps of a pair; a function of the user may have changed. Collective."""
    if not callable(contact.initial_gap):
        return earlier.gap
    nothing = np.zeros_like(earlier.gap)
    points, name = earlier.coordinates, earlier.name
    return initial_gap(comm, contact.initial_gap, earlier.gap, nothing, points, name)


def contact_rows(pairings: Sequence[ContactPairing], gdim: int) -> ContactRows:
    """Return the contact conditions of all contacts, one contact after the other."""
    if not pairings:
        return ContactRows.none(gdim)
    return ContactRows.concatenate([p.rows(number) for number, p in enumerate(pairings)])


def _match_pair(
    boundary: MeshBoundary, name: str, contact: ContactPair, prescribed: Prescribed
) -> ContactPairing:
    comm = boundary.space.mesh.comm
    tags, partners = contact.facet_tags, contact.partners
    if isinstance(partners, NodePartners):
        with raise_collectively(comm):
            _check_degree(partners, name, boundary.degree)
    slave = tagged_surface(boundary, tags, contact.slave, f"slave of {name}", contact.normal)
    tagged_master = tagged_surface(boundary, tags, contact.master, f"master of {name}")
    if isinstance(partners, NodePartners):
        return _match_nodes(boundary, name, contact, partners, slave, tagged_master)
    master = gather_nearby(boundary, tags, contact.master, contact.slave, slave.nodes)
    number = comm.allreduce(tagged_master.nodes.size)
    shared = _shared_nodes(comm, name, slave, master.nodes, number, contact.partial)
    with raise_collectively(comm):
        normals = master.normals(name)
    near = Nearest()
    may_pair_nodes = partners is None and boundary.degree == 1
    if may_pair_nodes and meshes_match(slave, master, normals, near.tolerance):
        return _match_nodes(boundary, name, contact, near, slave, tagged_master)
    fixed = prescribed_components(slave, prescribed)
    pairing = match_by_mortar(boundary, name, contact, slave, master, shared, fixed)
    summary = {**pairing.summary, "slave": contact.slave, "master": contact.master}
    return replace(pairing, master_surface=tagged_master, summary=summary)


def _check_degree(partners: NodePartners, name: str, degree: int) -> None:
    """Check that conditions between pairs of nodes are for displacements of degree 1."""
    if degree > 1:
        raise InputError(
            f"{name}: partners={type(partners).__name__}(...) asks for conditions between pairs of "
            f"nodes, which are for displacements of degree 1; this one is of degree {degree}. "
            "Leave it out: the conditions are mortar conditions then"
        )


def _match_nodes(
    boundary: MeshBoundary,
    name: str,
    contact: ContactPair,
    how: NodePartners,
    slave: Surface,
    tagged_master: Surface,
) -> ContactPairing:
    comm = boundary.space.mesh.comm
    master = gather_master(comm, tagged_master)
    number = master.nodes.size
    shared = _shared_nodes(comm, name, slave, master.nodes, number, contact.partial)
    master = master.without(shared)

    partners = find_partners(comm, how, slave, master, name)
    partners.distance[np.isin(slave.nodes, shared)] = np.inf
    limit = how.tolerance * slave.size
    check_partners(comm, slave, partners, limit, contact.partial, name)
    paired = partners.distance <= limit
    check_one_to_one(comm, slave, master, partners, paired, contact.partial, name)

    partner_rows = partners.master[paired]
    angle = angles_between(slave.normal[paired], -master.normal[partner_rows])
    check_facing(comm, slave, paired, angle, name)
    partner = master.points[partner_rows]
    covered = _covered_facets(slave, paired, partner, name)
    area = node_areas(slave, covered, name)
    normal = slave.normal[paired]
    gap = slave.without_rounding(np.sum((partner - slave.points[paired]) * normal, axis=1))
    places = slave.coordinates[paired]
    # the nodes of both surfaces are on it, up to their chords
    chord = 2.0 * _nodal_chords(slave)[paired]
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
    )


def _nodal_chords(slave: Surface) -> Vector:
    """Return at each node the largest chord height of the slave's facets there. Collective."""
    return slave.max_of_facets(chord_heights(slave.corners, slave.at_corners(slave.normal)))


def _shared_nodes(
    comm: MPI.Intracomm, name: str, slave: Surface, master: Numbers, number: int, partial: bool
) -> Numbers:
    """Return the nodes, on all ranks, that are slave and master, such as the tip of a crack.

    `master` are the master's nodes that may be this rank's slave nodes, `number` is that of all.
    """
    is_shared = np.isin(slave.nodes, master)
    shared = concatenate_ranks(comm, slave.nodes[is_shared])
    partly = shared.size < number
    check_shared_nodes(comm, slave, is_shared, partial and partly, name)
    return shared


def _covered_facets(slave: Surface, paired: Mask, partner: Vector, name: str) -> Mask:
    """Tell which of this rank's facets have partners at all nodes; check that none cross."""
    images = np.full_like(slave.points, np.nan)
    images[paired] = partner
    images, normals = slave.at_corners(images), slave.at_corners(slave.normal)
    check_not_crossed(slave.boundary.nodes.comm, slave, slave.corners, normals, images, name)
    covered: Mask = np.isfinite(images).all(axis=(1, 2))
    return covered
