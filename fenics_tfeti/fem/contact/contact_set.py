"""All contacts and tied surfaces of a problem, as they were found at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.bonds import Bonds
from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    ContactConditions,
    SlaveValues,
    contact_rows,
)
from fenics_tfeti.fem.contact.conditions.deformed import (
    DeformedContact,
    MortarsByNormals,
    deformed_contacts,
    mortars_by_normals,
)
from fenics_tfeti.fem.contact.conditions.friction import (
    NodalFriction,
    SlipOrigin,
    friction_rows,
    nodal_friction,
)
from fenics_tfeti.fem.contact.conditions.laws import NodalLaw, nodal_law
from fenics_tfeti.fem.contact.conditions.ties import Preload, TiedConditions
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, Patch, RigidObstacle
from fenics_tfeti.fem.contact.descriptions.laws import BondLaw, Cohesive, RoughContact
from fenics_tfeti.fem.contact.descriptions.rigid_body import RigidBody
from fenics_tfeti.fem.contact.descriptions.roles import Roles
from fenics_tfeti.fem.contact.descriptions.ties import BoltPreload, Tie
from fenics_tfeti.fem.contact.rigid.frames import BodyFrame, RigidBodies
from fenics_tfeti.fem.contact.rigid.nodes import RigidNodes
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.displacement import prescribed_components
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti.system import ContactRows, Friction, Prescribed, Subdomain
from fenics_tfeti.parallel import positions
from fenics_tfeti.typing import Array, Numbers, Vector


@dataclass(frozen=True)
class OnBody:
    """Where the conditions of a contact are on its rigid body, and where its slave's nodes are."""

    places: Vector  # (k, gdim), less the translation of the body: its motion displaces these
    slave: Vector  # (k, gdim)


@dataclass(frozen=True)
class FoundContact:
    """A contact with its conditions, of the undeformed or of the deformed surfaces."""

    number: int  # among all contacts and tied pairs
    contact_key: str  # from step to step and in files, see `contact_keys`
    roles: Roles  # the contact as the user gave it and as it is used
    conditions: ContactConditions
    undeformed: ContactConditions
    friction: NodalFriction | None = None  # at `conditions`, without bonds
    law: NodalLaw | None = None  # at `conditions`
    on_body: OnBody | None = None  # where the conditions are on a rigid body
    rigid_master: RigidBody | None = None  # the body of the mesh that the master belongs to
    part: int = 0  # of the contact, see `match_pairs`
    patch: int = 0  # of a surface that touches itself, see `SelfPatches`

    @property
    def key(self) -> str:
        """The key of the part of the contact."""
        patch = f", patch {self.patch + 1}" if self.patch else ""
        return self.contact_key + patch + (f", part {self.part + 1}" if self.part else "")

    @property
    def history(self) -> str:
        """The key of values at nodes from step to step and in files, whatever patches they are in.

        That of patches is their contact's: facets may change the patch.
        """
        return self.contact_key if isinstance(self.contact, Patch) else self.key

    @property
    def contact(self) -> Contact:
        """The contact in the roles that are used."""
        return self.roles.used

    @property
    def gap(self) -> Vector:
        """Gaps of the undeformed surfaces (k,) [m]; infinite at nodes without condition there."""
        if self.conditions is self.undeformed:
            return self.undeformed.gap
        place = positions(self.undeformed.slave, self.conditions.slave)
        return np.append(self.undeformed.gap, np.inf)[place]

    @property
    def along(self) -> NodalFriction | None:
        """Friction along the surface, and springs of bonds and layers where these hold.

        Bonds that do not hold along the surface leave it to friction.
        """
        stiffness = None if self.law is None else self.law.stiffness_along
        if self.friction is None or stiffness is None:
            return self.friction
        return self.friction.bonded(stiffness)

    @property
    def body(self) -> RigidBody | None:
        """The rigid body that the obstacle is a surface of."""
        return self.contact.rigid_body if isinstance(self.contact, RigidObstacle) else None

    def law_at_conditions(self) -> NodalLaw | None:
        """Return the law at the conditions; bonds are those of undeformed areas. Collective."""
        if not isinstance(getattr(self.contact, "law", None), Cohesive):
            return nodal_law(self.contact, self.conditions)
        law = nodal_law(self.contact, self.undeformed)
        assert law is not None and law.bonds is not None
        known = positions(self.undeformed.slave, self.conditions.slave)
        nothing = np.zeros((1, law.bonds.columns().shape[1]))
        columns = np.concatenate([law.bonds.columns(), nothing])[known]
        return NodalLaw.of_bonds(Bonds.from_columns(columns))

    def with_bonded_pairs(self) -> FoundContact:
        """Return the contact with what was opposite each other in conditions of bonds. Collective.

        Their weights do not change as edges of facets move across each other.
        """
        law, new, first = self.law, self.conditions, self.undeformed
        assert law is not None and law.damage is not None
        if isinstance(self.contact, RigidObstacle):
            return self
        jump = first.mean_jumps(first.surface.boundary.nodes.coordinates)
        place = np.where(law.damage < 1.0, positions(first.slave, new.slave), -1)
        gap = np.where(place >= 0, -np.sum(jump[place] * new.normal, axis=1), new.gap)
        terms = new.terms.replaced(first.terms, place)
        return replace(self, conditions=replace(new, terms=terms, gap=gap))

    def jumps_along(self, displacement: Vector) -> Vector:
        """Return how far bonds are sheared (k, gdim - 1) along the tangents [m]. Collective.

        It is the jump of what was opposite each other, and turns with the surface, at displacements
        (owned, gdim).
        """
        along, undeformed = self.along, self.undeformed
        assert along is not None
        place = positions(undeformed.slave, self.conditions.slave)
        moved = undeformed.mean_jumps(displacement)
        if isinstance(self.contact, RigidObstacle):
            jump = moved[place] - along.obstacle_displacement
        else:
            # what was beside each other turns by the least rotation of the normal
            first = undeformed.mean_jumps(undeformed.surface.boundary.nodes.coordinates)
            normal, turned = undeformed.normal[place], self.conditions.normal
            before = first[place] - np.sum(first[place] * normal, axis=1)[:, None] * normal
            cosine = np.sum(normal * turned, axis=1)
            part = np.sum(before * turned, axis=1) / np.maximum(1.0 + cosine, RELATIVE_ROUNDING)
            jump = (first + moved)[place] - before + part[:, None] * (normal + turned)
        return np.einsum("kta,ka->kt", along.tangents, jump)

    def placed(self, rigid: RigidNodes) -> FoundContact:
        """Return the contact with the places on its body, if it has one. Collective."""
        master = rigid.master_of(self.conditions.terms, self.conditions.name)
        if self.body is None:
            return replace(self, rigid_master=master)
        x = self.conditions.relative(rigid.nodes.coordinates)
        gap = self.conditions.gap
        return replace(self, on_body=OnBody(x + _along(self.conditions.normal, gap), x))

    def contact_at(self, bodies: RigidBodies) -> Contact:
        """Return the contact, with an obstacle on a rigid body where the body is."""
        contact = self.contact
        if isinstance(contact, RigidObstacle) and contact.rigid_body is not None:
            frame = bodies.frame_of(contact.rigid_body)
            contact = replace(contact, obstacle=frame.obstacle(contact.obstacle))
        return contact


@dataclass(frozen=True)
class FoundTie:
    """A tie with its rows."""

    number: int  # among all contacts and tied pairs
    tie: Tie
    conditions: TiedConditions
    rigid_master: RigidBody | None = None  # as of a contact


@dataclass(frozen=True)
class ContactSet:
    """Everything found at one moment: the conditions of all contacts, with friction, and ties."""

    boundary: MeshBoundary
    contacts: list[FoundContact]
    ties: list[FoundTie]
    prescribed: Prescribed  # the supports that they were found with
    bodies: RigidBodies
    rigid: RigidNodes

    @property
    def all_conditions(self) -> list[ContactConditions]:
        """The conditions of each contact."""
        return [found.conditions for found in self.contacts]

    @property
    def bonded(self) -> list[tuple[FoundContact, Bonds, Vector]]:
        """The contacts with bonds that can break, these bonds, and their damage (k,)."""
        return [
            (found, found.law.bonds, found.law.damage)
            for found in self.contacts
            if found.law is not None and found.law.bonds is not None
            if found.law.damage is not None
        ]

    def damaged(self, damage: SlaveValues) -> ContactSet:
        """Return the set with a damage (k,) of its bonds, which join what was opposite. Collective.

        Where bonds have failed contact is with what is opposite now.
        """
        contacts = list[FoundContact]()
        for found in self.contacts:
            law = found.law
            if law is not None and law.bonds is not None:
                known = damage.at(found.history, self.dofs(found.conditions.slave))
                law = law.damaged(np.maximum(law.bonds.intact(), known))
                found = replace(found, law=law).with_bonded_pairs()
            contacts.append(found)
        return replace(self, contacts=contacts)

    @property
    def adhesive(self) -> list[tuple[int, FoundContact, NodalLaw]]:
        """The numbers among `contacts` of those whose adhesion can end, and this law."""
        return [
            (number, found, found.law)
            for number, found in enumerate(self.contacts)
            if found.law is not None and found.law.reach is not None
        ]

    @property
    def rough(self) -> list[tuple[int, FoundContact, RoughContact]]:
        """The numbers among `contacts` of those with a law of the approach, and this law."""
        laws = [getattr(found.contact, "law", None) for found in self.contacts]
        triples = zip(range(len(laws)), self.contacts, laws, strict=True)
        return [(n, found, law) for n, found, law in triples if isinstance(law, RoughContact)]

    @property
    def keys(self) -> list[str]:
        """The key of each contact."""
        return [found.key for found in self.contacts]

    @property
    def histories(self) -> list[str]:
        """By what values at nodes are known from step to step and in files, each once."""
        return list(dict.fromkeys(found.history for found in self.contacts))

    def at_conditions(self, values: SlaveValues) -> Array:
        """Return values (k, ...) at the conditions of all contacts, one after the other."""
        parts = [
            values.at(found.history, self.dofs(found.conditions.slave)) for found in self.contacts
        ]
        return np.concatenate([np.zeros((0, *values.shape)), *parts])

    def slave_values(self, values: Vector) -> SlaveValues:
        """Return values (k,) at the conditions of all contacts by their slave nodes."""
        parts = (
            (self.dofs(found.conditions.slave), values[own])
            for found, own in zip(self.contacts, self.positions, strict=True)
        )
        return SlaveValues.of([found.history for found in self.contacts], parts)

    def sums(self, parts: Sequence[tuple[FoundContact, Vector]]) -> dict[str, float]:
        """Return the sums of values (k,) at contacts by their names. Collective."""
        sums = dict.fromkeys([found.conditions.name for found, _ in parts], 0.0)
        for found, values in parts:
            sums[found.conditions.name] += float(values.sum())
        return {name: self.boundary.nodes.comm.allreduce(own) for name, own in sums.items()}

    @property
    def entries(self) -> list[FoundContact | FoundTie]:
        """All contacts and tied pairs, by number."""
        return sorted([*self.contacts, *self.ties], key=lambda found: found.number)

    @property
    def names(self) -> list[str]:
        """Names of all contacts and tied pairs, by number."""
        # a contact may have several parts
        return [*{found.number: found.conditions.name for found in self.entries}.values()]

    def rows(self) -> ContactRows:
        """Return the conditions of all contacts, one contact after the other. Collective."""
        numbers = [found.number for found in self.contacts]
        rows = contact_rows(self.all_conditions, self.boundary.nodes.components, numbers)
        for found, own_rows in zip(self.contacts, self.positions, strict=True):
            if found.on_body is not None:
                frame, places = self.bodies.frame_of(found.body), found.on_body.places
                of_body = -(rows.length[:, None] * rows.normal)[own_rows]
                moved = frame.displacements(frame.body.prescribed_motion, places)
                rows = frame.joined(rows, own_rows, places, of_body, moved)
        return self._with_laws(self.rigid.joined(rows, self.bodies))

    def _with_laws(self, rows: ContactRows) -> ContactRows:
        """Return the conditions with the springs and the adhesion of laws."""
        compliance, adhesion = np.array(rows.compliance), np.array(rows.adhesion)
        gap = rows.gap.copy()
        for found, own_rows in zip(self.contacts, self.positions, strict=True):
            if found.law is not None:
                compliance[own_rows] = found.law.compliance
                adhesion[own_rows] = found.law.adhesion
                if found.law.touching is not None:
                    gap[own_rows] -= found.law.touching * rows.length[own_rows]
        return replace(rows, gap=gap, compliance=compliance, adhesion=adhesion)

    @property
    def positions(self) -> list[Numbers]:
        """The positions (k,) of each contact's conditions among all of them."""
        return consecutive([found.conditions.gap.size for found in self.contacts])

    def tied_rows(self) -> ContactRows:
        """Return the rows of all ties, one tie after the other. Collective."""
        if not self.ties:
            return ContactRows.none(self.boundary.space.mesh.geometry.dim)
        rows = [
            replace(tie.conditions.rows, contact=np.full(tie.conditions.rows.size, tie.number))
            for tie in self.ties
        ]
        return self.rigid.joined(ContactRows.concatenate(rows), self.bodies)

    def friction_rows(self, origin: SlipOrigin, start: Vector | None = None) -> Friction:
        """Return friction, with slips of unknowns counted from a start (n,) or zero. Collective."""
        nodes, sites = self.boundary.nodes, []
        for found, own_rows in zip(self.contacts, self.positions, strict=True):
            along = found.along
            if along is not None:
                moved = self._obstacle_motion(found, along, origin)
                sites.append((own_rows, along, moved))
        if not sites:
            return Friction.none(nodes.components)
        displacement = origin.displacement - (0.0 if start is None else start)
        displacement = self.rigid.relative_to_unknowns(displacement, self.bodies)
        rows = contact_rows(self.all_conditions, nodes.components)
        return friction_rows(nodes, rows, sites, displacement)

    def with_bond_slips(self, friction: Friction, displacement: Vector) -> Friction:
        """Return friction with the slips of bonds of all load steps. Collective.

        The displacement (n,) is at the degrees of freedom that this rank owns [m].
        """
        slip, first = np.array(friction.slip), 0
        u = displacement.reshape(-1, self.boundary.nodes.components)
        for found in self.contacts:
            stiffness = None if found.law is None else found.law.stiffness_along
            if found.along is not None:
                sites = slice(first, first + found.conditions.gap.size)
                first = sites.stop
                if stiffness is not None:
                    held = (stiffness > 0.0)[:, None]
                    slip[sites] = np.where(held, -found.jumps_along(u), slip[sites])
        return replace(friction, slip=slip)

    def _obstacle_motion(
        self, found: FoundContact, friction: NodalFriction, origin: SlipOrigin
    ) -> Vector:
        """Return what an obstacle has moved (k, gdim) since the origin of slip. Collective.

        Of a body it is what is not among the unknowns, with all but the present rotation of the
        slip: the slave's nodes have slid from one place of the body to another.
        """
        nodes, conditions, on = self.boundary.nodes, found.conditions, found.on_body
        earlier = origin.obstacles.at(found.history, self.dofs(conditions.slave))
        if on is None:
            return friction.obstacle_displacement - earlier
        frame, u = self.bodies.frame_of(found.body), origin.displacement
        start = conditions.relative(nodes.coordinates + u.reshape(-1, nodes.components))
        slid = frame.turn(frame.undeformed_places(on.slave) - (start - earlier))
        moved = frame.displacements(frame.motion_outside_unknowns(self.bodies.from_here), on.places)
        return on.slave - start + moved - slid

    def with_friction(self, uh: Function | None = None) -> ContactSet:
        """Return the set with friction and laws at its conditions, by default undeformed.

        Collective.
        """
        given = [vars(found.contact) for found in self.contacts]
        if all(data["friction"] is None and data.get("law") is None for data in given):
            return self
        fixed = prescribed_components(self.boundary.nodes, self.prescribed)
        boundary = self.boundary if uh is None else self.boundary.deformed(uh)
        contacts = []
        for found in self.contacts:
            bond = getattr(found.contact, "law", None)
            holds = isinstance(bond, BondLaw) and bond.holds_along
            friction = nodal_friction(found.contact, found.conditions, fixed, boundary, holds)
            law = found.law_at_conditions()
            contacts.append(replace(found, friction=friction, law=law))
        return replace(self, contacts=contacts)

    def with_turned_ties(self, uh: Function) -> ContactSet:
        """Return the set with axes of bolts and gaps of tied surfaces that turn. Collective."""
        nodes, ties = self.boundary.nodes, list(self.ties)
        for k, found in enumerate(ties):
            conditions = found.conditions
            if conditions.of_means is not None:
                turned = conditions.with_turned_gaps(self.boundary.deformed(uh))
                ties[k] = replace(found, conditions=turned)
            if isinstance(found.tie, BoltPreload) and found.tie.turns:
                held = np.isin(conditions.nodes, self.prescribed.nodes)
                points = conditions.coordinates[:, : nodes.components]
                if bad := first_wrong(nodes.comm, held, points):
                    raise InputError(
                        f"{conditions.name}: displacements are prescribed at {bad.number} nodes of "
                        f"the cut, the first at {bad.place}, which hold the axis: a bolt with "
                        "turns=True needs a cut whose slave side is free. Leave turns out, or cut "
                        "the shank where nothing is prescribed"
                    )
                ties[k] = replace(found, conditions=conditions.with_turned_axis(uh))
        return replace(self, ties=ties)

    def added_subdomains(self, first: int) -> list[Subdomain]:
        """Return this rank's rigid bodies and unknown shortenings, numbered from `first` on."""
        first += len(self.bodies.frames)
        bolts = [p.subdomain(first + k) for k, (_, p) in enumerate(self._preloads)]
        return self.bodies.subdomains() + bolts[self._own_preloads]

    @property
    def added_names(self) -> list[str]:
        """The names of the bodies of all ranks that are not of the mesh, by number."""
        return [
            *self.bodies.names,
            *(f"shortening of {tie.conditions.name}" for tie, _ in self._preloads),
        ]

    @property
    def _preloads(self) -> list[tuple[FoundTie, Preload]]:
        """The bolts whose shortening is an unknown of the torn system."""
        found = ((tie, tie.conditions.preload) for tie in self.ties)
        return [(tie, preload) for tie, preload in found if preload is not None and preload.body]

    @property
    def _own_preloads(self) -> slice:
        """Which of all ranks' bolts with an unknown shortening this one has."""
        comm = self.boundary.nodes.comm
        return slice(comm.rank, None, comm.size)

    def shortenings(self, displacements: Sequence[Vector]) -> dict[int, float]:
        """Return shortenings by number of the bolt, of displacements of subdomains. Collective."""
        preloads = self._preloads
        values, own = np.zeros(len(preloads)), preloads[self._own_preloads]
        last = displacements[len(displacements) - len(own) :]
        values[self._own_preloads] = [u @ p.axis for u, (_, p) in zip(last, own, strict=True)]
        self.boundary.nodes.comm.Allreduce(MPI.IN_PLACE, values)
        return {tie.number: float(x) for (tie, _), x in zip(preloads, values, strict=True)}

    def bolt_displacements(self, displacements: Sequence[Vector]) -> Vector:
        """Return those (b, gdim) of the nodes of bolts, which are beyond the mesh. Collective."""
        nodes, own = self.boundary.nodes, self._preloads[self._own_preloads]
        last = max((tie.number for tie, _ in self._preloads), default=-1)
        values = np.zeros((last + 1, nodes.components))
        for (_, preload), u in zip(
            own, displacements[len(displacements) - len(own) :], strict=True
        ):
            assert preload.body is not None
            values[preload.body.nodes - nodes.total] = u.reshape(-1, nodes.components)
        nodes.comm.Allreduce(MPI.IN_PLACE, values)
        return values

    def motions_after(self, displacements: Sequence[Vector]) -> list[Vector]:
        """Return the motions of all rigid bodies after displacements of subdomains. Collective."""
        bolts = len(self._preloads[self._own_preloads])
        of_bodies = displacements[: len(displacements) - bolts]
        return self.bodies.motions_after(of_bodies)

    def deformed(
        self, uh: Function, bodies: RigidBodies | None = None, last: ContactSet | None = None
    ) -> tuple[ContactSet, list[DeformedContact]]:
        """Return the conditions of the deformed surfaces, and what was measured. Collective.

        The rigid bodies are by default where they were. Partners and nodes with conditions stay
        near those of the `last` set for the same contacts, by default this one. Friction is still
        that at the conditions before, see `with_friction`.
        """
        bodies, contacts = bodies or self.bodies, []
        known = {found.key: found.conditions for found in (last or self).contacts}
        # the nodes of surfaces may have moved since
        all_conditions = [
            replace(
                known[found.key],
                surface=found.undeformed.surface,
                master_surface=found.undeformed.master_surface,
            )
            for found in self.contacts
        ]
        at_bodies = [found.contact_at(bodies) for found in self.contacts]
        # rows of small strains act on undeformed bodies, which given normals leave free to turn
        is_finite = bodies.from_here
        measured = deformed_contacts(
            list(zip(at_bodies, all_conditions, strict=True)), uh, is_finite, self._mortars
        )
        for found, new in zip(self.contacts, measured, strict=True):
            found = replace(found, conditions=new.conditions)
            if found.body is not None:
                found = self._on_body(found, bodies.frame_of(found.body), uh)
            contacts.append(found)
        return replace(self, contacts=contacts, bodies=bodies), measured

    @cached_property
    def _mortars(self) -> MortarsByNormals:
        """The joined surfaces of mortar conditions. The first time collective."""
        return mortars_by_normals([(found.contact, found.conditions) for found in self.contacts])

    def _on_body(self, found: FoundContact, frame: BodyFrame, uh: Function) -> FoundContact:
        """Return a contact with a gap in terms of all of its body's motion. Collective."""
        nodes, conditions, motion = self.boundary.nodes, found.conditions, frame.motion
        u = conditions.relative(nodes.values(uh)[: nodes.owned])
        x = conditions.relative(nodes.coordinates) + u
        distance = conditions.gap - np.sum(u * conditions.normal, axis=1)
        places = x + _along(conditions.normal, distance) - motion[: nodes.components]
        moved = np.sum(conditions.normal * frame.displacements(motion, places), axis=1)
        conditions = replace(conditions, gap=conditions.gap - moved)
        return replace(found, conditions=conditions, on_body=OnBody(places, x))

    def has_same_contacts(self, other: ContactSet) -> bool:
        """Tell whether another set was found for the same contacts in the same roles."""
        used = {found.key: found.contact for found in other.contacts}
        return len(used) == len(self.contacts) and all(
            used.get(found.key) is found.contact for found in self.contacts
        )

    def dofs(self, nodes: Numbers) -> Numbers:
        """Return the numbers on this rank of nodes that it owns."""
        return nodes - self.boundary.nodes.first


def consecutive(sizes: Sequence[int]) -> list[Numbers]:
    """Return the positions (k,) of consecutive parts of some sizes."""
    return np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]) if sizes else []


def _along(normal: Vector, distance: Vector) -> Vector:
    """Return normals (k, gdim) times distances (k,), zero for infinite ones."""
    return normal * np.where(np.isfinite(distance), distance, 0.0)[:, None]
