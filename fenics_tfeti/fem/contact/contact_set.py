"""All contacts and tied surfaces of a problem, as they were found at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.checks import check_depth
from fenics_tfeti.fem.contact.contact import ContactPairing, contact_rows, openings
from fenics_tfeti.fem.contact.deformed import DeformedContact, deformed_contact
from fenics_tfeti.fem.contact.description import Contact, ContactPair, RigidObstacle, TiedPair
from fenics_tfeti.fem.contact.matched import linear_rows, periodic_rows, preload_rows
from fenics_tfeti.fem.contact.matching import match_contacts
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.result import (
    BoltResult,
    ContactEntry,
    ContactResult,
    Results,
    TiedResult,
)
from fenics_tfeti.fem.contact.rigid_body import (
    BodyFrame,
    BodyPlace,
    RigidBody,
    RigidBodyResult,
    find_frames,
)
from fenics_tfeti.fem.contact.roles import (
    Roles,
    describe_roles,
    exchanged,
    nodal_stiffness,
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
    obstacle_displacements,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.contact.tied import Preload, TiedPairing, tie_surfaces
from fenics_tfeti.fem.contact.ties import BoltPreload, LinearRows, PeriodicPair, Tie, tie_name
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
class FoundContact:
    """A contact with its conditions, of the undeformed or of the deformed surfaces."""

    number: int  # among all contacts and tied pairs
    roles: Roles  # the contact as the user gave it and as it is used
    pairing: ContactPairing
    undeformed: ContactPairing
    friction: NodalFriction | None = None  # at `pairing`
    # (k, gdim): places of the conditions on a rigid body, without its translation; None without one
    on_body: Vector | None = None

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

    def placed(self, nodes: NodeMap) -> FoundContact:
        """Return the contact with the places on its body, if it has one. Collective."""
        if self.body is None:
            return self
        x = self.pairing.relative(nodes, nodes.coordinates)
        gap = self.pairing.gap
        return replace(self, on_body=x + _along(self.pairing.normal, gap))

    def measured(self, uh: Function, frame: BodyFrame | None, place: BodyPlace | None) -> Any:
        """Measure normals, gaps and penetration in the deformed state. Collective.

        The place is that of the frame of the contact's body.
        """
        contact = self.contact
        if frame is None or place is None:
            return deformed_contact(contact, self.pairing, uh)
        assert isinstance(contact, RigidObstacle)
        moved = replace(contact, obstacle=place.obstacle(frame.body, contact.obstacle))
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


@dataclass(frozen=True)
class ContactSet:
    """Everything found at one moment: the conditions of all contacts, with friction, and ties."""

    boundary: MeshBoundary
    contacts: list[FoundContact]
    ties: list[FoundTie]
    prescribed: Prescribed  # the supports that they were found with
    frames: list[BodyFrame] = field(default_factory=list)  # of rigid bodies
    places: list[BodyPlace] = field(default_factory=list)  # where these are

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
        """Return the conditions of all contacts, one contact after the other."""
        parts = [ContactRows.none(self.boundary.space.mesh.geometry.dim)]
        for found in self.contacts:
            rows, frame = found.pairing.rows(found.number), self.frame_of(found)
            parts.append(rows if frame is None else frame.joined(rows, _places(found)))
        return ContactRows.concatenate(parts)

    def frame_of(self, found: FoundContact) -> BodyFrame | None:
        """Return the frame of a contact's rigid body; None without one."""
        return next((frame for frame in self.frames if frame.body is found.body), None)

    def tied_rows(self) -> ContactRows:
        """Return the rows of all ties, one tie after the other."""
        if not self.ties:
            return ContactRows.none(self.boundary.space.mesh.geometry.dim)
        return ContactRows.concatenate(
            [
                replace(tie.pairing.rows, contact=np.full(tie.pairing.rows.size, tie.number))
                for tie in self.ties
            ]
        )

    def friction_rows(self, origin: SlipOrigin) -> Friction:
        """Return where `rows` have friction, and from where slip is counted. Collective."""
        rows = contact_rows(self.pairings, self.boundary.space.mesh.geometry.dim)
        return friction_rows(self.boundary.nodes, rows, self.pairings, self.friction, origin)

    def with_friction(self) -> ContactSet:
        """Return the set with friction evaluated at its conditions. Collective."""
        space = self.boundary.space
        contacts = [found.with_friction(space, self.prescribed) for found in self.contacts]
        return replace(self, contacts=contacts)._moved_by(
            [frame.body.prescribed_motion for frame in self.frames]
        )

    def _moved_by(self, motions: Sequence[Vector]) -> ContactSet:
        """Return the set with the displacements of bodies as those of their obstacles."""
        contacts = list(self.contacts)
        for k, found in enumerate(contacts):
            frame = self.frame_of(found)
            if frame is not None and found.friction is not None:
                motion = motions[self.frames.index(frame)]
                moved = frame.displacements(motion, _places(found))
                friction = replace(found.friction, obstacle_displacement=moved)
                contacts[k] = replace(found, friction=friction)
        return replace(self, contacts=contacts)

    def obstacle_displacements(self) -> Vector:
        """Return each obstacle's displacement at the slave's nodes, as in `SlipOrigin`."""
        return obstacle_displacements(self.boundary.nodes, self.pairings, self.friction)

    def added_subdomains(self, first: int) -> list[Subdomain]:
        """Return this rank's rigid bodies and shortenings that are unknown, with their loads now.

        The mesh has as many bodies as `first`, the number of the first one here.
        """
        first += len(self.frames)
        bodies = [s for k in self._own(self.frames) for s in self.frames[k].subdomains()]
        preloads = self._preloads
        return bodies + [preloads[k][1].subdomain(first + k) for k in self._own(preloads)]

    @property
    def added_names(self) -> list[str]:
        """The names of the bodies of all ranks that are not of the mesh, by number."""
        bolts = [f"shortening of {tie.pairing.name}" for tie, _ in self._preloads]
        return [*(frame.name for frame in self.frames), *bolts]

    @property
    def _preloads(self) -> list[tuple[FoundTie, Preload]]:
        """The bolts whose shortening is an unknown of the torn system."""
        found = ((tie, tie.pairing.preload) for tie in self.ties)
        return [(tie, preload) for tie, preload in found if preload is not None and preload.body]

    def _own(self, bodies: Sequence[object]) -> range:
        """Return which of all ranks' bodies this one has."""
        comm = self.boundary.nodes.comm
        return range(comm.rank, len(bodies), comm.size)

    def _added_motions(
        self, displacements: Sequence[Vector]
    ) -> tuple[list[Vector], dict[int, float]]:
        """Return the motions of rigid bodies, and shortenings by number of the bolt. Collective.

        They are those of `added_subdomains`, with which the displacements of subdomains end.
        """
        comm, frames, preloads = self.boundary.nodes.comm, self.frames, self._preloads
        motions = np.zeros((len(frames), max((frame.body.modes for frame in frames), default=0)))
        values = np.zeros(len(preloads))
        added = iter(displacements[len(displacements) - len(self.added_subdomains(0)) :])
        for k in self._own(frames):
            # the spring of a body moves as the body does
            motions[k], *_ = [frames[k].motion(next(added)) for _ in frames[k].templates]
        for k in self._own(preloads):
            values[k] = next(added) @ preloads[k][1].axis
        comm.Allreduce(MPI.IN_PLACE, motions)
        comm.Allreduce(MPI.IN_PLACE, values)
        shortenings = {tie.number: value for (tie, _), value in zip(preloads, values, strict=True)}
        return list(motions), shortenings

    def deformed(
        self, uh: Function, places: Sequence[BodyPlace] = ()
    ) -> tuple[ContactSet, list[DeformedContact]]:
        """Return the conditions of the deformed surfaces, and what was measured. Collective.

        `places` are those of the rigid bodies. Friction is still that at the conditions before, see
        `with_friction`.
        """
        measured, contacts = [], []
        for found in self.contacts:
            frame = self.frame_of(found)
            place = None if frame is None else places[self.frames.index(frame)]
            new = found.measured(uh, frame, place)
            measured.append(new)
            after = replace(found, pairing=new.pairing(found.pairing))
            if frame is not None and place is not None:
                after = self._at_place(after, frame, place, uh, new.distance)
            contacts.append(after)
        return replace(self, contacts=contacts, places=list(places)), measured

    def _at_place(
        self,
        found: FoundContact,
        frame: BodyFrame,
        place: BodyPlace,
        uh: Function,
        distance: Vector,
    ) -> FoundContact:
        """Return a contact with a gap in terms of all of its body's motion. Collective."""
        nodes, pairing = self.boundary.nodes, found.pairing
        x = nodes.coordinates + nodes.values(uh)[: nodes.owned]
        places = pairing.relative(nodes, x) + _along(pairing.normal, distance)
        places -= place.motion[: frame.body.gdim]
        moved = np.sum(pairing.normal * frame.displacements(place.motion, places), axis=1)
        return replace(found, pairing=replace(pairing, gap=pairing.gap - moved), on_body=places)

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
        return replace(self, contacts=contacts, places=other.places).with_friction()

    def solved(self, solution: TornSolution, uh: Function) -> SolvedContacts:
        """Return the solution at each contact and tied pair. Collective."""
        opening = openings(self.boundary.nodes, self.pairings, owned_values(uh))
        motions, shortenings = self._added_motions(solution.displacements)
        contacts, ties, row, site = [], [], 0, 0
        for found, gap_after in zip(self.contacts, opening, strict=True):
            frame = self.frame_of(found)
            if frame is not None:
                motion = motions[self.frames.index(frame)]
                moved = frame.displacements(motion, _places(found))
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
        places = [p.moved(motion) for p, motion in zip(self.places, motions, strict=True)]
        bodies = [
            self._body_result(frame, place, solution)
            for frame, place in zip(self.frames, places, strict=True)
        ]
        return SolvedContacts(self._moved_by(motions), contacts, ties, uh, bodies, places)

    def _body_result(
        self, frame: BodyFrame, place: BodyPlace, solution: TornSolution
    ) -> RigidBodyResult:
        force, moment = np.zeros(frame.body.gdim), np.zeros(frame.body.modes - frame.body.gdim)
        for found in self.contacts:
            if found.body is frame.body:
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
            self._dofs(pairing.slave),
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
            comm=self.boundary.space.mesh.comm,
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
            self._dofs(tie.nodes),
            tie.coordinates,
            force,
            force / tie.area[:, None],
            tie.area,
            self.boundary.space.mesh.comm,
        )

    def _dofs(self, nodes: Numbers) -> Numbers:
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
    bodies: list[RigidBodyResult]
    places: list[BodyPlace]  # of the bodies

    def as_given(self) -> Results:
        """Return the results by number, in the roles that the user gave."""
        numbered: dict[int, ContactResult | TiedResult] = {}
        for found, result in zip(self.conditions.contacts, self.contacts, strict=True):
            is_exchanged = found.roles.used is not found.roles.given
            numbered[found.number] = result.seen_from_master() if is_exchanged else result
        for tie, tied_result in zip(self.conditions.ties, self.ties, strict=True):
            numbered[tie.number] = tied_result
        return Results([numbered[number] for number in sorted(numbered)])

    def nodal_forces(self) -> Vector:
        """Return the normal forces (contacts, nodes) at the nodes that this rank owns [N]."""
        size = self.conditions.boundary.nodes.owned
        force = np.zeros((len(self.contacts), size))
        for values, result in zip(force, self.contacts, strict=True):
            values[result.dofs] = result.normal_force
        return force

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
    ) -> None:
        self._space, self._bodies, self._timer = space, bodies, timer
        self._displacement = displacement
        self._measure_weight = measure_weight
        self._roles: list[Roles] = []
        self.forget()

    def forget(self) -> None:
        """Find the boundary of the mesh anew, because its nodes were moved. Collective."""
        self._last: ContactSet | None = None
        with self._timer.phase("contact search"):
            self.boundary = MeshBoundary.of(self._space, self._measure_weight)

    def find(self, contacts: Sequence[Contact | Tie], prescribed: Prescribed) -> ContactSet:
        """Return the undeformed conditions; only what changed is searched again. Collective."""
        touching, ties = dict[int, Roles](), dict[int, Tie]()
        for number, contact in enumerate(contacts):
            if isinstance(contact, Tie):
                ties[number] = contact
            else:
                touching[number] = self._roles_of(contact) or Roles(contact, contact)
        with self._timer.phase("contact search"):
            last = self._last or ContactSet(self.boundary, [], [], prescribed)
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
                FoundContact(number, roles, pairing, pairing).placed(self.boundary.nodes)
                for (number, roles), pairing in zip(touching.items(), pairings, strict=True)
            ]
            found_ties = [
                FoundTie(number, tie, self._tied(tie, number, last, prescribed))
                for number, tie in ties.items()
            ]
            frames = self._frames(found_contacts, last.frames, len(contacts))
            places = [BodyPlace.undeformed(frame.body) for frame in frames]
            found = ContactSet(
                self.boundary, found_contacts, found_ties, prescribed, frames, places
            ).with_friction()
        self._last = found
        return found

    def _tied(self, tie: Tie, number: int, last: ContactSet, prescribed: Prescribed) -> TiedPairing:
        """Return the rows of a tie, known ones if they still hold. Collective."""
        name = tie_name(tie, number)
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

    def _frames(
        self, contacts: Sequence[FoundContact], known: Sequence[BodyFrame], bolts: int
    ) -> list[BodyFrame]:
        """Return the frames of the contacts' rigid bodies. Collective.

        Their nodes are numbered after those of the mesh and of as many bolts.
        """
        comm, gdim = self._space.mesh.comm, self._space.mesh.geometry.dim
        bodies = list(dict.fromkeys(found.body for found in contacts if found.body is not None))
        for found in contacts:
            if found.body is not None and found.body.gdim != gdim:
                raise InputError(
                    f"{found.pairing.name}: the reference point of the body has "
                    f"{found.body.gdim} coordinates, the mesh {gdim}"
                )

        def box_of(body: RigidBody) -> Vector:
            x = [_places(found) for found in contacts if found.body is body]
            low, high = np.concatenate(x), np.concatenate(x)
            box = np.array([low.min(axis=0, initial=np.inf), -high.max(axis=0, initial=-np.inf)])
            comm.Allreduce(MPI.IN_PLACE, box, MPI.MIN)
            return np.array([box[0], -box[1]])

        first = self.boundary.nodes.total + bolts, len(self._bodies.names)
        return find_frames(bodies, box_of, first, known)

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


def _places(found: FoundContact) -> Vector:
    """Return the places of a contact's conditions on its body."""
    assert found.on_body is not None
    return found.on_body
