"""All contacts and tied surfaces of a problem, as they were found at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace, locate_dofs_topological

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.checks import check_depth
from fenics_tfeti.fem.contact.contact import ContactPairing, SlaveValues, contact_rows, openings
from fenics_tfeti.fem.contact.deformed import DeformedContact, deformed_contact
from fenics_tfeti.fem.contact.description import (
    BoltPreload,
    Contact,
    ContactPair,
    LinearRows,
    PeriodicPair,
    RigidObstacle,
    Tie,
    TiedPair,
    contact_name,
)
from fenics_tfeti.fem.contact.matching import match_contacts
from fenics_tfeti.fem.contact.obstacles.rigid_body import (
    BodyFrame,
    BodyPlace,
    RigidBodies,
    RigidBody,
    RigidBodyResult,
    find_frames,
)
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.result import (
    BoltResult,
    ContactEntry,
    ContactResult,
    Results,
    TiedResult,
)
from fenics_tfeti.fem.contact.rigid_nodes import RigidNodes
from fenics_tfeti.fem.contact.roles import (
    Roles,
    describe_roles,
    exchanged,
    nodal_stiffness,
    one_sided_data,
    prefers_exchange,
    roles_ratio,
    warn_of_roles,
)
from fenics_tfeti.fem.contact.slip import (
    NodalFriction,
    SlipOrigin,
    friction_result,
    friction_rows,
    nodal_friction,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.contact.ties import (
    Preload,
    TiedPairing,
    linear_rows,
    periodic_rows,
    preload_rows,
    tie_surfaces,
)
from fenics_tfeti.fem.contact.transfer import SolvedContact, gather_solved
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.report.resultants import ContactForces
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.feti.system import ContactRows, Friction, Prescribed, Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class OnBody:
    """Where the conditions of a contact are on its rigid body, and where its slave's nodes are."""

    places: Vector  # (k, gdim), less the translation of the body: its motion displaces these
    slave: Vector  # (k, gdim)


@dataclass(frozen=True)
class FoundContact:
    """A contact with its conditions, of the undeformed or of the deformed surfaces."""

    number: int  # among all contacts and tied pairs
    roles: Roles  # the contact as the user gave it and as it is used
    pairing: ContactPairing
    undeformed: ContactPairing
    friction: NodalFriction | None = None  # at `pairing`
    on_body: OnBody | None = None  # where the conditions are on a rigid body
    rigid_master: RigidBody | None = None  # the body of the mesh that the master belongs to

    @property
    def contact(self) -> Contact:
        """The contact in the roles that are used."""
        return self.roles.used

    @property
    def gap(self) -> Vector:
        """Gaps of the undeformed surfaces (k,) [m]; infinite at nodes without condition there."""
        nodes, gaps = self.undeformed.slave, self.undeformed.gap
        _, rows, rows_of_gaps = np.intersect1d(self.pairing.slave, nodes, return_indices=True)
        gap = np.full(self.pairing.slave.size, np.inf)
        gap[rows] = gaps[rows_of_gaps]
        return gap

    @property
    def body(self) -> RigidBody | None:
        """The rigid body that the obstacle is a surface of."""
        return self.contact.body if isinstance(self.contact, RigidObstacle) else None

    def placed(self, nodes: NodeMap, rigid: RigidNodes) -> FoundContact:
        """Return the contact with the places on its body, if it has one. Collective."""
        master = rigid.master_of(self.pairing.rows(self.number), self.pairing.name)
        if self.body is None:
            return replace(self, rigid_master=master)
        x = self.pairing.relative(nodes, nodes.coordinates)
        gap = self.pairing.gap
        return replace(self, on_body=OnBody(x + _along(self.pairing.normal, gap), x))

    def measured(self, uh: Function, place: BodyPlace | None) -> DeformedContact:
        """Measure normals, gaps and penetration in the deformed state. Collective.

        The place is that of the contact's body, if it has one.
        """
        contact = self.contact
        if place is None:
            return deformed_contact(contact, self.pairing, uh)
        assert isinstance(contact, RigidObstacle) and contact.body is not None
        moved = replace(contact, obstacle=place.obstacle(contact.body, contact.obstacle))
        return deformed_contact(moved, self.pairing, uh)

    def with_friction(self, space: FunctionSpace, prescribed: Prescribed) -> FoundContact:
        """Return the contact with friction evaluated at its conditions. Collective."""
        friction = nodal_friction(space, self.contact, self.pairing, prescribed)
        return replace(self, friction=friction)


@dataclass(frozen=True)
class FoundTie:
    """A tie with its rows."""

    number: int  # among all contacts and tied pairs
    tie: Tie
    pairing: TiedPairing
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
    # whether unknowns are displacements from the deformed state of the conditions
    from_here: bool = False

    @property
    def pairings(self) -> list[ContactPairing]:
        """The conditions of each contact."""
        return [found.pairing for found in self.contacts]

    @property
    def friction(self) -> list[NodalFriction | None]:
        """Friction at the conditions of each contact."""
        return [found.friction for found in self.contacts]

    @property
    def names(self) -> list[str]:
        """Names of all contacts and tied pairs, by number."""
        entries: list[FoundContact | FoundTie] = [*self.contacts, *self.ties]
        return [found.pairing.name for found in sorted(entries, key=lambda found: found.number)]

    def rows(self) -> ContactRows:
        """Return the conditions of all contacts, one contact after the other. Collective."""
        parts = [ContactRows.none(self.boundary.space.mesh.geometry.dim)]
        for found in self.contacts:
            rows, k = found.pairing.rows(found.number), self.bodies.number(found.body)
            if k is not None and found.on_body is not None:
                rows = self.bodies.frames[k].joined(rows, found.on_body.places)
            parts.append(rows)
        return self.rigid.joined(ContactRows.concatenate(parts), self.bodies)

    def tied_rows(self) -> ContactRows:
        """Return the rows of all ties, one tie after the other. Collective."""
        if not self.ties:
            return ContactRows.none(self.boundary.space.mesh.geometry.dim)
        rows = [
            replace(tie.pairing.rows, contact=np.full(tie.pairing.rows.size, tie.number))
            for tie in self.ties
        ]
        return self.rigid.joined(ContactRows.concatenate(rows), self.bodies)

    def friction_rows(self, origin: SlipOrigin, start: Vector | None = None) -> Friction:
        """Return where `rows` have friction, and from where slip is counted. Collective.

        Unknowns are displacements from a start (n,), by default the undeformed state.
        """
        rows = contact_rows(self.pairings, self.boundary.space.mesh.geometry.dim)
        friction = list(self.friction)
        for k, (found, nodal) in enumerate(zip(self.contacts, self.friction, strict=True)):
            if found.on_body is not None and nodal is not None:
                moved = self._slip_of_body(found, found.on_body, origin, k)
                friction[k] = replace(nodal, obstacle_displacement=moved)
        displacement = origin.displacement - (0.0 if start is None else start)
        displacement = self.rigid.relative_to_unknowns(displacement, self.bodies, self.from_here)
        origin = replace(origin, displacement=displacement)
        return friction_rows(self.boundary.nodes, rows, self.pairings, friction, origin)

    def _slip_of_body(self, found: FoundContact, on: OnBody, origin: SlipOrigin, k: int) -> Vector:
        """Return the displacement (k, gdim) of a body that slip is relative to. Collective.

        It is what is not among the unknowns, with all but the present rotation of the slip: the
        slave's nodes have slid from one place of the body to another.
        """
        number, nodes, pairing = self.bodies.number(found.body), self.boundary.nodes, found.pairing
        assert number is not None
        frame, place = self.bodies.frames[number], self.bodies.places[number]
        u = origin.displacement.reshape(-1, nodes.components)
        start = pairing.relative(nodes, nodes.coordinates + u)
        earlier = origin.obstacles.at(k, self.dofs(pairing.slave))
        now = place.undeformed_places(frame.body, on.slave)
        slid = place.turn(now - (start - earlier))
        ahead = frame.displacements(self.bodies.ahead(number, self.from_here), on.places)
        moved: Vector = earlier + on.slave - start + ahead - slid
        return moved

    def with_friction(self) -> ContactSet:
        """Return the set with friction evaluated at its conditions. Collective."""
        space = self.boundary.space
        contacts = [found.with_friction(space, self.prescribed) for found in self.contacts]
        return replace(self, contacts=contacts)

    def added_subdomains(self, first: int) -> list[Subdomain]:
        """Return this rank's rigid bodies and shortenings that are unknown, with their loads now.

        The mesh has as many bodies as `first`, the number of the first one here.
        """
        bodies, preloads = self.bodies.subdomains(self.from_here), self._preloads
        first += len(self.bodies.frames)
        return bodies + [preloads[k][1].subdomain(first + k) for k in self._own(preloads)]

    @property
    def added_names(self) -> list[str]:
        """The names of the bodies of all ranks that are not of the mesh, by number."""
        return [
            *self.bodies.names,
            *(f"shortening of {tie.pairing.name}" for tie, _ in self._preloads),
        ]

    @property
    def _preloads(self) -> list[tuple[FoundTie, Preload]]:
        """The bolts whose shortening is an unknown of the torn system."""
        found = ((tie, tie.pairing.preload) for tie in self.ties)
        return [(tie, preload) for tie, preload in found if preload is not None and preload.body]

    def _own(self, bodies: Sequence[object]) -> range:
        """Return which of all ranks' bodies this one has."""
        comm = self.boundary.nodes.comm
        return range(comm.rank, len(bodies), comm.size)

    def _shortenings(self, displacements: Sequence[Vector]) -> dict[int, float]:
        """Return shortenings by number of the bolt. Collective.

        They are those of `added_subdomains`, with which the displacements of subdomains end.
        """
        preloads = self._preloads
        values, mine = np.zeros(len(preloads)), self._own(preloads)
        for k, displacement in zip(
            mine, displacements[len(displacements) - len(mine) :], strict=True
        ):
            values[k] = displacement @ preloads[k][1].axis
        self.boundary.nodes.comm.Allreduce(MPI.IN_PLACE, values)
        return {tie.number: value for (tie, _), value in zip(preloads, values, strict=True)}

    def motions_after(self, displacements: Sequence[Vector]) -> list[Vector]:
        """Return the motions of all rigid bodies after displacements of subdomains. Collective.

        The displacements end with those of `added_subdomains`.
        """
        bolts = len(self._own(self._preloads))
        of_bodies = displacements[: len(displacements) - bolts]
        return self.bodies.motions_after(of_bodies, self.from_here)

    def deformed(
        self, uh: Function, bodies: RigidBodies | None = None
    ) -> tuple[ContactSet, list[DeformedContact]]:
        """Return the conditions of the deformed surfaces, and what was measured. Collective.

        The rigid bodies are by default where they were. Friction is still that at the conditions
        before, see `with_friction`.
        """
        bodies, measured, contacts = bodies or self.bodies, [], []
        for found in self.contacts:
            k = bodies.number(found.body)
            new = found.measured(uh, None if k is None else bodies.places[k])
            measured.append(new)
            after = replace(found, pairing=new.pairing)
            contacts.append(
                after if k is None else self._on_body(after, bodies, k, uh, new.distance)
            )
        return replace(self, contacts=contacts, bodies=bodies), measured

    def _on_body(
        self, found: FoundContact, bodies: RigidBodies, k: int, uh: Function, distance: Vector
    ) -> FoundContact:
        """Return a contact with a gap in terms of all of its body's motion. Collective."""
        nodes, pairing, motion = self.boundary.nodes, found.pairing, bodies.places[k].motion
        x = pairing.relative(nodes, nodes.coordinates + nodes.values(uh)[: nodes.owned])
        places = x + _along(pairing.normal, distance) - motion[: nodes.components]
        moved = np.sum(pairing.normal * bodies.frames[k].displacements(motion, places), axis=1)
        pairing = replace(pairing, gap=pairing.gap - moved)
        return replace(found, pairing=pairing, on_body=OnBody(places, x))

    def has_same_contacts(self, other: ContactSet) -> bool:
        """Tell whether another set was found for the same contacts in the same roles."""
        return len(self.contacts) == len(other.contacts) and all(
            a.contact is b.contact for a, b in zip(self.contacts, other.contacts, strict=True)
        )

    def at_conditions_of(self, other: ContactSet) -> ContactSet:
        """Return the set with the conditions of another one for the same contacts. Collective."""
        contacts = [
            replace(found, pairing=earlier.pairing, on_body=earlier.on_body)
            for found, earlier in zip(self.contacts, other.contacts, strict=True)
        ]
        bodies = replace(other.bodies, frames=self.bodies.frames)
        return replace(self, contacts=contacts, bodies=bodies).with_friction()

    def bodies_after(self, solution: TornSolution) -> RigidBodies:
        """Return the rigid bodies where a solution moves them. Collective."""
        return self.bodies.moved(self.motions_after(solution.displacements))

    def solved(
        self, solution: TornSolution, uh: Function, bodies: RigidBodies | None = None
    ) -> SolvedContacts:
        """Return the solution at each contact and tied pair. Collective.

        The rigid bodies are by default where the solution moves them.
        """
        opening = openings(self.boundary.nodes, self.pairings, owned_values(uh))
        if bodies is None:
            bodies = self.bodies_after(solution)
        shortenings = self._shortenings(solution.displacements)
        contacts, ties, row, site = [], [], 0, 0
        for found, gap_after in zip(self.contacts, opening, strict=True):
            k = bodies.number(found.body)
            if k is not None and found.on_body is not None:
                moved = bodies.frames[k].displacements(bodies.motions[k], found.on_body.places)
                gap_after += np.sum(found.pairing.normal * moved, axis=1)
            rows = slice(row, row + found.pairing.slave.size)
            sites = slice(site, site + (0 if found.friction is None else rows.stop - row))
            row, site = rows.stop, sites.stop
            contacts.append(self._result(found, gap_after, solution, rows, sites))
        row = 0
        for tie in self.ties:
            rows = slice(row, row + tie.pairing.rows.size)
            row = rows.stop
            forces = solution.report.contacts[tie.number]
            values = solution.tied_force[rows]
            ties.append(self._tied_result(tie, forces, values, shortenings))
        results = [
            self._body_result(frame, place, solution)
            for frame, place in zip(bodies.frames, bodies.places, strict=True)
        ]
        return SolvedContacts(self, contacts, ties, uh, bodies, results)

    def _body_result(
        self, frame: BodyFrame, place: BodyPlace, solution: TornSolution
    ) -> RigidBodyResult:
        force, moment = np.zeros(frame.body.gdim), np.zeros(frame.body.modes - frame.body.gdim)
        entries: list[FoundContact | FoundTie] = [*self.contacts, *self.ties]
        for found in entries:
            is_obstacle = isinstance(found, FoundContact) and found.body is frame.body
            if is_obstacle or found.rigid_master is frame.body:
                entry = solution.report.contacts[found.number]
                force += entry.force_on_master
                moment += entry.moment_on_master
        return RigidBodyResult.of(frame, place, force, moment)

    def _result(
        self,
        found: FoundContact,
        opening: Vector,
        solution: TornSolution,
        rows: slice,
        sites: slice,
    ) -> ContactResult:
        pairing, force = found.pairing, solution.normal_force[rows]
        forces, roles = vars(solution.report.contacts[found.number]), found.roles
        return ContactResult(
            pairing.name,
            ContactEntry(**forces, pairing=found.undeformed.summary, **roles.entries()),
            pairing.slave,
            self.dofs(pairing.slave),
            pairing.coordinates,
            found.gap,
            opening,
            pairing.normal,
            normal_force=force,
            pressure=force / pairing.area,
            active=force > 0.0,
            area=pairing.area,
            coverage=np.ones_like(force) if pairing.coverage is None else pairing.coverage,
            friction=friction_result(
                found.friction,
                pairing,
                solution.tangential_force[sites],
                solution.slip[sites],
                solution.sticking[sites],
                solution.slip_bound[sites],
            ),
            comm=self.boundary.nodes.comm,
        )

    def _tied_result(
        self,
        found: FoundTie,
        forces: ContactForces,
        row_forces: Vector,
        shortenings: Mapping[int, float],
    ) -> TiedResult:
        """Return the result of a tie from the forces of its rows."""
        tie, force = found.pairing, found.pairing.forces(row_forces)
        entry = ContactEntry(**vars(forces), pairing=tie.summary)
        if tie.preload is not None:
            shortening = tie.preload.shortening
            if shortening is None:
                shortening = float(shortenings[found.number])
            tension = float(np.array(entry.force) @ tie.preload.axis)
            entry = replace(entry, tension=tension, shortening=shortening)
        return (TiedResult if tie.preload is None else BoltResult)(
            tie.name,
            entry,
            tie.nodes,
            self.dofs(tie.nodes),
            tie.coordinates,
            force,
            force / tie.area[:, None],
            tie.area,
            self.boundary.nodes.comm,
        )

    def dofs(self, nodes: Numbers) -> Numbers:
        """Return the numbers on this rank of nodes that it owns."""
        dofs: Numbers = nodes - self.boundary.nodes.first
        return dofs


@dataclass(frozen=True)
class SolvedContacts:
    """A solution at contacts and tied pairs, with the conditions that it fulfils."""

    conditions: ContactSet
    contacts: list[ContactResult]  # in the roles that are used
    ties: list[TiedResult]
    displacement: Function
    bodies: RigidBodies
    body_results: list[RigidBodyResult]

    def as_given(self) -> Results:
        """Return the results by number, in the roles that the user gave."""
        numbered: dict[int, ContactResult | TiedResult] = {}
        for found, result in zip(self.conditions.contacts, self.contacts, strict=True):
            is_exchanged = found.roles.used is not found.roles.given
            numbered[found.number] = result.seen_from_master() if is_exchanged else result
        for tie, tied_result in zip(self.conditions.ties, self.ties, strict=True):
            numbered[tie.number] = tied_result
        return Results([numbered[number] for number in sorted(numbered)])

    def obstacle_displacements(self) -> SlaveValues:
        """Return the displacements of obstacles where there is friction, as in `SlipOrigin`."""
        conditions, parts = self.conditions, []
        gdim = conditions.boundary.nodes.components
        for found in conditions.contacts:
            k, on, moved = self.bodies.number(found.body), found.on_body, np.zeros((0, gdim))
            if found.friction is not None:
                moved = found.friction.obstacle_displacement
                if k is not None and on is not None:
                    frame, before = self.bodies.frames[k], conditions.bodies.places[k]
                    step = frame.displacements(self.bodies.motions[k] - before.motion, on.places)
                    moved = on.slave - before.undeformed_places(frame.body, on.slave) + step
            parts.append((conditions.dofs(found.pairing.slave)[: len(moved)], moved))
        return SlaveValues.of(parts, gdim)

    def nodal_forces(self) -> SlaveValues:
        """Return the normal forces (k,) [N]."""
        return SlaveValues.of((result.dofs, result.normal_force) for result in self.contacts)

    def gathered(self) -> list[SolvedContact]:
        """Gather the solution on the slaves' surfaces on every rank. Collective."""
        return gather_solved(self.conditions.pairings, self.contacts, self.displacement)


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
        self._roles: list[Roles] = []
        self._made_master: list[Roles] = []  # pairs whose slave was rigid
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
                touching[number] = self._roles_of(contact) or self._first_roles(contact)
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
                self._found_tie(number, tie, last, prescribed) for number, tie in ties.items()
            ]
            bodies = self._rigid_bodies(found_contacts, last.bodies, len(contacts))
            found = ContactSet(
                self.boundary, found_contacts, found_ties, prescribed, bodies, self.rigid
            ).with_friction()
        self._last = found
        return found

    def _first_roles(self, contact: Contact) -> Roles:
        """Return the roles of a new contact: a rigid surface is the master. Collective."""
        known = next((roles for roles in self._made_master if roles.given is contact), None)
        if known is not None or not isinstance(contact, ContactPair):
            return known or Roles(contact, contact)
        may_exchange = contact.roles == "auto" and one_sided_data(contact) is None
        is_rigid = [
            self.rigid.on_surface(self._nodes_of(contact, tag))
            for tag in (contact.slave, contact.master)
        ]
        if is_rigid != [True, False] or not may_exchange:
            return Roles(contact, contact)
        reason = "slave and master are exchanged: the given slave is rigid"
        self._made_master.append(Roles(contact, exchanged(contact), None, reason))
        return self._made_master[-1]

    def _nodes_of(self, contact: ContactPair, tag: int) -> Numbers:
        """Return this rank's nodes on facets with a tag; wrong tags are found later."""
        dim, domain = self._space.mesh.topology.dim - 1, self._space.mesh
        tags = contact.facet_tags
        if not (_compat.tags_are_on(tags, domain) and tags.dim == dim):
            return np.zeros(0, dtype=np.int64)
        facets = tags.find(tag)
        return np.asarray(locate_dofs_topological(self._space, dim, facets), dtype=np.int64)

    def _found_tie(
        self, number: int, tie: Tie, last: ContactSet, prescribed: Prescribed
    ) -> FoundTie:
        pairing = self._tied(tie, number, last, prescribed)
        return FoundTie(number, tie, pairing, self.rigid.master_of(pairing.rows, pairing.name))

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
        """Return the contacts' rigid bodies where nothing has moved. Collective.

        Their nodes are numbered after those of the mesh and of as many bolts.
        """
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

        first = self.boundary.nodes.total + bolts, self._bodies.deformable
        frames = find_frames(bodies, box_of, first, known.frames)
        return RigidBodies(comm, gdim, frames, [BodyPlace.undeformed(body) for body in bodies])

    def with_roles(
        self, found: ContactSet, contacts: Sequence[Contact | Tie], torn: Sequence[Subdomain]
    ) -> ContactSet:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self._space.mesh.comm
        new = [
            index
            for index, entry in enumerate(found.contacts)
            if isinstance(entry.contact, ContactPair) and self._roles_of(entry.roles.given) is None
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

    def _roles_of(self, contact: Contact) -> Roles | None:
        return next((roles for roles in self._roles if roles.given is contact), None)

    def _decide_roles(
        self,
        found: ContactSet,
        index: int,
        contacts: Sequence[Contact | Tie],
        stiffness: Vector,
    ) -> ContactSet:
        """Decide the roles of one pair, and find all conditions anew if they are exchanged."""
        comm, entry = self._space.mesh.comm, found.contacts[index]
        pair, pairing = entry.roles.given, entry.undeformed
        assert isinstance(pair, ContactPair)
        if entry.roles.used is not pair:
            self._roles.append(entry.roles)
            return found
        ratio = roles_ratio(pairing, stiffness)
        roles = Roles(pair, pair, ratio, describe_roles(pair, ratio, False, None))
        if ratio is not None and prefers_exchange(pair, ratio):
            reason = describe_roles(pair, ratio, True, None)
            self._roles.append(Roles(pair, exchanged(pair), 1.0 / ratio, reason))
            try:
                found = self.find(contacts, found.prescribed)
                roles = self._roles[-1]
            except InputError as error:
                # surfaces that can be masters only, such as folded ones, or masters of other pairs
                reason = describe_roles(pair, ratio, False, str(error))
                roles = replace(roles, reason=reason)
            self._roles.pop()
        self._roles.append(roles)
        with raise_collectively(comm):
            if roles.ratio is not None and comm.rank == 0:
                warn_of_roles(pairing.name, roles.ratio)
        found_contacts = list(found.contacts)
        found_contacts[index] = replace(found_contacts[index], roles=roles)
        return replace(found, contacts=found_contacts)


def _along(normal: Vector, distance: Vector) -> Vector:
    """Return normals (k, gdim) times distances (k,), zero for infinite ones."""
    steps: Vector = normal * np.where(np.isfinite(distance), distance, 0.0)[:, None]
    return steps
