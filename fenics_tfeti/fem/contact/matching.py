"""The search for the conditions of contacts and ties (sec. 11.1, 11.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace, locate_dofs_topological

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.checks import (
    check_depth,
    check_different_nodes,
    check_different_surfaces,
)
from fenics_tfeti.fem.contact.contact import ContactPairing
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact, FoundTie
from fenics_tfeti.fem.contact.description import (
    BoltPreload,
    Contact,
    ContactPair,
    LinearRows,
    Nearest,
    NodePartners,
    PeriodicPair,
    RigidObstacle,
    Tie,
    TiedPair,
    contact_name,
)
from fenics_tfeti.fem.contact.mortar.pairing import match_by_mortar
from fenics_tfeti.fem.contact.nodes import match_nodes, meshes_match, shared_nodes
from fenics_tfeti.fem.contact.obstacles.conditions import match_obstacle
from fenics_tfeti.fem.contact.obstacles.rigid_body import BodyFrame, RigidBodies, RigidBody
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.rigid_nodes import RigidNodes
from fenics_tfeti.fem.contact.roles import (
    Roles,
    describe_roles,
    exchanged,
    may_exchange,
    nodal_stiffness,
    prefers_exchange,
    roles_ratio,
    warn_of_roles,
)
from fenics_tfeti.fem.contact.surfaces.initial_gap import initial_gap
from fenics_tfeti.fem.contact.surfaces.nearby import gather_nearby
from fenics_tfeti.fem.contact.surfaces.normals import (
    prescribed_components,
    still_holds,
    without_axial_tilt,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.contact.ties import (
    TiedPairing,
    linear_rows,
    periodic_rows,
    preload_rows,
    tie_surfaces,
)
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.feti.system import Prescribed, Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector


class ContactSearch:
    """The search for the conditions of a problem's contacts and tied pairs.

    What was found is used again as long as the user's contacts and the nodes of the mesh are the
    same. It also decides, once for each pair, whether slave and master are exchanged. Obstacles are
    evaluated on the surfaces deformed by a displacement, if one is given.
    """

    def __init__(
        self,
        space: FunctionSpace,
        bodies: Bodies,
        measure_weight: Any,
        timer: Timer,
        displacement: Function | None = None,
        rigid: Mapping[int, RigidBody] | None = None,
    ) -> None:
        self._space, self._bodies, self._timer = space, bodies, timer
        self._rigid_tags = rigid or {}
        self._displacement = displacement
        self._measure_weight = measure_weight
        self._roles = dict[int, Roles]()  # of pairs, by `id`
        self.forget()

    def forget(self) -> None:
        """Find the boundary of the mesh anew, because its nodes were moved. Collective."""
        self._last: ContactSet | None = None
        with self._timer.phase("contact search"):
            self.boundary = MeshBoundary.of(self._space, self._measure_weight)
            self.rigid = RigidNodes.of(
                self._space, self._bodies, self._rigid_tags, self.boundary.coordinates
            )

    def find(self, contacts: Sequence[Contact | Tie], prescribed: Prescribed) -> ContactSet:
        """Return the undeformed conditions; only what changed is searched again. Collective."""
        touching, ties = dict[int, Roles](), dict[int, Tie]()
        for number, contact in enumerate(contacts):
            if isinstance(contact, Tie):
                ties[number] = contact
            else:
                touching[number] = self._roles_of(contact)
        self.rigid.check_supports(prescribed)
        with self._timer.phase("contact search"):
            none = RigidBodies(self._space.mesh.comm, self._space.mesh.geometry.dim)
            last = self._last or ContactSet(self.boundary, [], [], prescribed, none, self.rigid)
            known = [(found.contact, found.undeformed) for found in last.contacts]
            pairings = match_contacts(
                self.boundary,
                [roles.used for roles in touching.values()],
                known,
                prescribed,
                list(touching),
                self._displacement,
            )
            checked = {id(pairing) for _, pairing in known}
            check_depth(self._space, self._bodies, [p for p in pairings if id(p) not in checked])
            found_contacts = [
                FoundContact(number, roles, pairing, pairing).placed(
                    self.boundary.nodes, self.rigid
                )
                for (number, roles), pairing in zip(touching.items(), pairings, strict=True)
            ]
            found_ties = [
                FoundTie(number, tie, pairing, self.rigid.master_of(pairing.rows, pairing.name))
                for number, tie in ties.items()
                for pairing in [self._tied(tie, number, last, prescribed)]
            ]
            bodies = self._rigid_bodies(found_contacts, last.bodies, len(contacts))
            found = ContactSet(
                self.boundary, found_contacts, found_ties, prescribed, bodies, self.rigid
            ).with_friction()
        self._last = found
        return found

    def _roles_of(self, contact: Contact) -> Roles:
        """Return the roles of a contact; of a pair a rigid surface is the master. Collective."""
        if not isinstance(contact, ContactPair):
            return Roles(contact, contact)
        if id(contact) not in self._roles:
            roles, tags = Roles(contact, contact), (contact.slave, contact.master)
            is_rigid = [self.rigid.on_surface(self._nodes_of(contact, tag)) for tag in tags]
            if is_rigid == [True, False] and may_exchange(contact):
                reason = "slave and master are exchanged: the given slave is rigid"
                roles = replace(roles, used=exchanged(contact), reason=reason)
            self._roles[id(contact)] = roles
        return self._roles[id(contact)]

    def _nodes_of(self, contact: ContactPair, tag: int) -> Numbers:
        """Return this rank's nodes on facets with a tag; wrong tags are found later."""
        dim, domain = self._space.mesh.topology.dim - 1, self._space.mesh
        tags = contact.facet_tags
        if not (_compat.tags_are_on(tags, domain) and tags.dim == dim):
            return np.zeros(0, dtype=np.int64)
        facets = tags.find(tag)
        return np.asarray(locate_dofs_topological(self._space, dim, facets), dtype=np.int64)

    def _tied(self, tie: Tie, number: int, last: ContactSet, prescribed: Prescribed) -> TiedPairing:
        """Return the rows of a tie, known ones if they still hold. Collective."""
        name = contact_name(tie, number)
        known = next((found.pairing for found in last.ties if found.tie is tie), None)
        if known is not None and known.still_holds(prescribed):
            return known
        match tie:
            case TiedPair():
                return tie_surfaces(self.boundary, tie, name, prescribed)
            case PeriodicPair():
                return periodic_rows(self.boundary, tie, name)
            case BoltPreload():
                preloads = [found.pairing.preload for found in last.ties if found.number == number]
                return preload_rows(self.boundary, tie, number, name, *(preloads or [None]))
            case LinearRows():
                return linear_rows(self.boundary, tie, name)

    def _rigid_bodies(
        self, contacts: Sequence[FoundContact], known: RigidBodies, bolts: int
    ) -> RigidBodies:
        """Return the rigid bodies, with nodes after those of the mesh and of bolts. Collective."""
        comm, gdim = self._space.mesh.comm, self._space.mesh.geometry.dim
        of_contacts = [found.body for found in contacts if found.body is not None]
        bodies = list(dict.fromkeys([*self.rigid.bodies, *of_contacts]))
        for found in contacts:
            if found.body is not None and found.body.gdim != gdim:
                raise InputError(
                    f"{found.pairing.name}: the reference point of the body has "
                    f"{found.body.gdim} coordinates, the mesh {gdim}"
                )

        def box_of(body: RigidBody) -> Vector:
            on = [found.on_body for found in contacts if found.body is body]
            parts = [part.places for part in on if part is not None]
            x = np.concatenate([*parts, self.rigid.places_of(body)])
            box = np.array([x.min(axis=0, initial=np.inf), -x.max(axis=0, initial=-np.inf)])
            comm.Allreduce(MPI.IN_PLACE, box, MPI.MIN)
            return np.array([box[0], -box[1]])

        frames = [
            BodyFrame.undeformed(
                body,
                body.name or f"rigid body {k}",
                box_of(body),
                self.boundary.nodes.total + bolts + k * (gdim + 1),
                self._bodies.deformable + k,
                known.frames[k] if k < len(known.frames) else None,
            )
            for k, body in enumerate(bodies)
        ]
        return RigidBodies(comm, gdim, frames)

    def with_roles(
        self, found: ContactSet, contacts: Sequence[Contact | Tie], torn: Sequence[Subdomain]
    ) -> ContactSet:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self._space.mesh.comm
        new = [
            index
            for index, entry in enumerate(found.contacts)
            if isinstance(entry.contact, ContactPair) and not entry.roles.are_decided
        ]
        if not new:
            return found
        stiffness = nodal_stiffness(self.boundary.nodes, torn)
        for index in new:
            found = self._decide_roles(found, index, contacts, stiffness)
        with raise_collectively(comm):
            for index in new if comm.rank == 0 else ():
                warn_of_deviation(found.contacts[index].undeformed.summary)
        return found

    def _decide_roles(
        self, found: ContactSet, index: int, contacts: Sequence[Contact | Tie], stiffness: Vector
    ) -> ContactSet:
        """Decide the roles of one pair, and find all conditions anew if they are exchanged."""
        comm, entry = self._space.mesh.comm, found.contacts[index]
        pair, roles = entry.roles.given, replace(entry.roles, are_decided=True)
        assert isinstance(pair, ContactPair)
        ratio = roles_ratio(entry.undeformed, stiffness)
        if roles.used is pair and ratio is not None:
            roles = replace(roles, ratio=ratio, reason=describe_roles(pair, ratio))
            if prefers_exchange(pair, ratio):
                reason = describe_roles(pair, ratio, exchange=True)
                self._roles[id(pair)] = Roles(pair, exchanged(pair), 1.0 / ratio, reason, True)
                try:
                    found = self.find(contacts, found.prescribed)
                    roles = self._roles[id(pair)]
                except InputError as error:
                    # surfaces that can be masters only, as folded ones, or masters of other pairs
                    reason = describe_roles(pair, ratio, obstacle=str(error))
                    roles = replace(roles, reason=reason)
            with raise_collectively(comm):
                if roles.ratio is not None and comm.rank == 0:
                    warn_of_roles(entry.pairing.name, roles.ratio)
        self._roles[id(pair)] = roles
        found_contacts = list(found.contacts)
        found_contacts[index] = replace(found_contacts[index], roles=roles)
        return replace(found, contacts=found_contacts)


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
    if callable(contact.initial_gap):
        # a function of the user may have changed
        comm, gap, points = boundary.nodes.comm, earlier.gap, earlier.coordinates
        gap = initial_gap(comm, contact.initial_gap, gap, np.zeros_like(gap), points, name)
        earlier = replace(earlier, gap=gap)
    if boundary.weight is None:
        return earlier
    area = earlier.surface.areas(earlier.covered, name)
    return replace(earlier, area=area[earlier.on_surface])


def _match_pair(
    boundary: MeshBoundary, name: str, contact: ContactPair, prescribed: Prescribed
) -> ContactPairing:
    comm = boundary.space.mesh.comm
    tags, partners = contact.facet_tags, contact.partners
    if isinstance(partners, NodePartners) and boundary.degree > 1:
        raise InputError(
            f"{name}: partners={type(partners).__name__}(...) asks for conditions between pairs of "
            "nodes, which are for displacements of degree 1; this one is of degree "
            f"{boundary.degree}. Leave it out: the conditions are mortar conditions then"
        )
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
