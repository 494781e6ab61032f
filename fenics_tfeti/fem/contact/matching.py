"""Contact conditions of tagged surfaces, with normals and gaps (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.checks import check_different_nodes, check_different_surfaces
from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.description import (
    Contact,
    ContactPair,
    Nearest,
    NodePartners,
    RigidObstacle,
    contact_name,
)
from fenics_tfeti.fem.contact.mortar.pairing import match_by_mortar
from fenics_tfeti.fem.contact.nodes.pairing import match_nodes, meshes_match, shared_nodes
from fenics_tfeti.fem.contact.obstacles.conditions import match_obstacle
from fenics_tfeti.fem.contact.surfaces.initial_gap import initial_gap
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.normals import (
    prescribed_components,
    still_holds,
    without_axial_tilt,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.feti.system import Prescribed
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector


def match_contacts(
    boundary: MeshBoundary,
    contacts: Sequence[Contact],
    known: Sequence[tuple[Contact, ContactPairing]] = (),
    prescribed: Prescribed | None = None,
    numbers: Sequence[int] | None = None,
    displacement: Function | None = None,
) -> list[ContactPairing]:
    """Match the surfaces of all contacts, and check that new ones overlap no others. Collective.

    Of the known results, pairs are not searched again, obstacles are evaluated again. Prescribed
    displacements of this rank's nodes tell planes of symmetry. The numbers are those of contacts
    without a name. Obstacles are evaluated on surfaces deformed by a displacement, if one is given.
    """
    comm, earlier = boundary.nodes.comm, {id(contact): pairing for contact, pairing in known}
    has_new = any(id(contact) not in earlier for contact in contacts)
    if has_new:
        check_different_surfaces(contacts, comm)
    pairings = [
        match_contact(boundary, contact, i, earlier.get(id(contact)), prescribed, displacement)
        for i, contact in zip(numbers or range(len(contacts)), contacts, strict=True)
    ]
    if has_new:
        check_different_nodes(contacts, pairings, comm)
    return pairings


def match_contact(
    boundary: MeshBoundary,
    contact: Contact,
    number: int,
    earlier: ContactPairing | None = None,
    prescribed: Prescribed | None = None,
    displacement: Function | None = None,
) -> ContactPairing:
    """Find the slave's nodes, normals, partners and gaps, this rank's part. Collective.

    The master's nodes are gathered on all ranks, of its facets those near each rank's slave facets.
    Of an earlier result, pairs of nodes are used again but for areas with a weight, which may have
    changed; mortar conditions if they have no weight and the same components are prescribed; of an
    obstacle's the surface.
    """
    name = contact_name(contact, number)
    if isinstance(contact, RigidObstacle):
        return match_obstacle(boundary, name, contact, earlier, displacement)
    supports = Prescribed() if prescribed is None else prescribed
    if earlier is not None and earlier.prescribed is not None:
        holds = still_holds(earlier.surface, supports, earlier.prescribed)
        earlier = earlier if holds else None
    if earlier is None:
        pairing = _match_pair(boundary, name, contact, supports)
        if contact.normal is not None:
            return pairing
        normal = without_axial_tilt(pairing.surface, pairing.slave, pairing.normal)
        return replace(pairing, normal=normal)
    gap = _updated_gap(contact, earlier)
    if boundary.weight is None:
        return earlier if gap is earlier.gap else replace(earlier, gap=gap)
    area = earlier.surface.areas(earlier.covered, name)
    return replace(earlier, gap=gap, area=area[earlier.on_surface])


def _updated_gap(contact: ContactPair, earlier: ContactPairing) -> Vector:
    """Return the gaps of a pair; a function of the user may have changed. Collective."""
    if not callable(contact.initial_gap):
        return earlier.gap
    nothing = np.zeros_like(earlier.gap)
    comm, points, name = earlier.surface.comm, earlier.coordinates, earlier.name
    return initial_gap(comm, contact.initial_gap, earlier.gap, nothing, points, name)


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
        return match_nodes(name, contact, partners, slave, tagged_master)
    master = gather_nearby(tagged_master, slave)
    number = comm.allreduce(tagged_master.nodes.size)
    shared = shared_nodes(name, slave, master.nodes, number, contact.partial)
    with raise_collectively(comm):
        master.check_not_folded(name)
    near = Nearest()
    may_pair_nodes = partners is None and boundary.degree == 1
    if may_pair_nodes and meshes_match(slave, master, near.tolerance):
        return match_nodes(name, contact, near, slave, tagged_master)
    fixed = prescribed_components(slave, prescribed)
    return match_by_mortar(name, contact, slave, tagged_master, master, shared, fixed)


def _check_degree(partners: NodePartners, name: str, degree: int) -> None:
    """Check that conditions between pairs of nodes are for displacements of degree 1."""
    if degree > 1:
        raise InputError(
            f"{name}: partners={type(partners).__name__}(...) asks for conditions between pairs of "
            f"nodes, which are for displacements of degree 1; this one is of degree {degree}. "
            "Leave it out: the conditions are mortar conditions then"
        )
