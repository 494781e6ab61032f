"""A solution at the contacts and ties of a problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeGuard

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    ContactConditions,
    SlaveValues,
    contact_rows,
    mean_traction,
    row_values,
)
from fenics_tfeti.fem.contact.conditions.friction import NodalFriction
from fenics_tfeti.fem.contact.conditions.laws import NodalLaw
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact, FoundTie, consecutive
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.laws import ElasticLayer, RoughContact, SoftContact
from fenics_tfeti.fem.contact.rigid.frames import BodyFrame, RigidBodies
from fenics_tfeti.fem.contact.solution.penetration import measured_penetration, whole_surfaces
from fenics_tfeti.fem.contact.solution.results import (
    BoltResult,
    ContactEntry,
    ContactResult,
    FrictionResult,
    Results,
    RigidBodyResult,
    TiedResult,
)
from fenics_tfeti.fem.contact.solution.transfer import SolvedContact, gather_solved
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.parallel import positions
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class SolvedContacts:
    """A solution at contacts and tied pairs, with the conditions that it fulfils."""

    contact_set: ContactSet
    contacts: list[ContactResult]  # in the roles that are used
    ties: list[TiedResult]
    displacement: Function
    bodies: RigidBodies
    body_results: list[RigidBodyResult]

    @staticmethod
    def of(
        contact_set: ContactSet,
        solution: TornSolution,
        uh: Function,
        bodies: RigidBodies,
        on_deformed: bool = False,
    ) -> SolvedContacts:
        """Return a solution that was found with conditions, and has moved bodies. Collective.

        Contact is on the deformed or on the undeformed surfaces.
        """
        nodes, found = contact_set.boundary.nodes, contact_set.contacts
        rows = contact_rows(contact_set.all_conditions, nodes.components)
        opening = (rows.gap - row_values(nodes, rows, owned_values(uh))) / rows.length
        sites = consecutive([(f.friction is not None) * f.conditions.gap.size for f in found])
        for f, own in zip(found, contact_set.positions, strict=True):
            if f.on_body is not None:
                frame = bodies.frame_of(f.body)
                moved = frame.displacements(frame.motion, f.on_body.places)
                opening[own] += np.sum(f.conditions.normal * moved, axis=1)
        uh.x.scatter_forward()
        deformed = contact_set.boundary.deformed(uh) if on_deformed else None
        contacts = [
            _contact_result(contact_set, f, solution, deformed, opening, *of_contact)
            for f, *of_contact in zip(found, contact_set.positions, sites, strict=True)
        ]
        rows_of_ties = consecutive([tie.conditions.rows.size for tie in contact_set.ties])
        shortenings = contact_set.shortenings(solution.displacements)
        ties = [
            _tied_result(contact_set, tie, solution, own, shortenings.get(tie.number))
            for tie, own in zip(contact_set.ties, rows_of_ties, strict=True)
        ]
        results = [_body_result(contact_set, frame, solution) for frame in bodies.frames]
        return SolvedContacts(contact_set, contacts, ties, uh, bodies, results)

    def with_penetration(self) -> SolvedContacts:
        """Return it with depths of nodes without a condition, told where they count. Collective."""
        contacts, parts = [], dict[tuple[int, int], list[ContactConditions]]()
        for found in self.contact_set.contacts:
            parts.setdefault((found.number, found.patch), []).append(found.undeformed)
        wholes = {
            pair: whole_surfaces(of_pair)
            for pair, of_pair in parts.items()
            if any(part.is_mortar for part in of_pair)
        }
        for found, result in zip(self.contact_set.contacts, self.contacts, strict=True):
            contact, conditions = found.contact, found.conditions
            if _is_hard(contact) and conditions.is_mortar:
                depth = measured_penetration(
                    contact,
                    found.undeformed,
                    wholes[found.number, found.patch],
                    conditions.slave,
                    self.displacement,
                )
                result = replace(result, entry=replace(result.entry, penetration=depth))
            contacts.append(result)
        return replace(self, contacts=contacts)

    def as_given(self) -> Results:
        """Return the results by number, in the roles that the user gave. Collective."""
        numbered: dict[int, ContactResult | TiedResult] = {}
        parts: dict[int, list[ContactResult]] = {}
        for found, result in zip(self.contact_set.contacts, self.contacts, strict=True):
            is_exchanged = found.roles.used is not found.roles.given
            result = result.seen_from_master() if is_exchanged else result
            parts.setdefault(found.number, []).append(result)
        joined = [ContactResult.joined(results) for results in parts.values()]
        comm = self.contact_set.boundary.nodes.comm
        numbered |= dict(zip(parts, _with_pressures(joined, comm), strict=True))
        for tie, tied_result in zip(self.contact_set.ties, self.ties, strict=True):
            numbered[tie.number] = tied_result
        return Results([numbered[number] for number in sorted(numbered)])

    def obstacle_displacements(self) -> SlaveValues:
        """Return the displacements of obstacles where there is friction, as in `SlipOrigin`.

        Elastic slip is added, which the next slips are not counted from.
        """
        contact_set, keys, parts = self.contact_set, list[str](), list[tuple[Numbers, Vector]]()
        for found, result in zip(contact_set.contacts, self.contacts, strict=True):
            along, on = found.along, found.on_body
            if along is None or result.friction is None:
                continue
            moved = along.obstacle_displacement
            if on is not None:
                before = contact_set.bodies.frame_of(found.body)
                motion = self.bodies.frame_of(found.body).motion - before.motion
                step = before.displacements(motion, on.places)
                moved = on.slave - before.undeformed_places(on.slave) + step
            # forces on the slave are against its slips
            moved = moved - along.elastic_slip(result.friction.force)
            keys.append(found.history)
            parts.append((contact_set.dofs(found.conditions.slave), moved))
        return SlaveValues.of(keys, parts, (contact_set.boundary.nodes.components,))

    def nodal_forces(self) -> SlaveValues:
        """Return the normal forces (k,) [N]."""
        parts = ((result.dofs, result.nodal_normal_force) for result in self.contacts)
        return SlaveValues.of([found.history for found in self.contact_set.contacts], parts)

    def damage(self) -> SlaveValues:
        """Return the damage (k,) of bonds that can break, and where adhesion has ended.

        Bonds at nodes that are opposite nothing have failed.
        """
        keys, parts = list[str](), list[tuple[Numbers, Vector]]()
        for found in self.contact_set.contacts:
            if found.law is not None and found.law.damage is not None:
                bonded = found.undeformed.slave
                place = positions(found.conditions.slave, bonded)
                keys.append(found.history)
                parts.append(
                    (self.contact_set.dofs(bonded), np.append(found.law.damage, 1.0)[place])
                )
        return SlaveValues.of(keys, parts)

    def gathered(self) -> dict[str, SolvedContact]:
        """Gather the solution on the slaves' surfaces on every rank, by contact. Collective."""
        solved = gather_solved(self.contact_set.all_conditions, self.contacts, self.displacement)
        return dict(zip(self.contact_set.keys, solved, strict=True))


def _with_pressures(results: list[ContactResult], comm: MPI.Intracomm) -> list[ContactResult]:
    """Add largest pressures, and numbers of nodes that press, to the entries. Collective."""
    largest = np.array([result.pressure.max(initial=0.0) for result in results])
    pressing = np.array([np.count_nonzero(r.nodal_normal_force > 0.0) for r in results], dtype=int)
    comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    comm.Allreduce(MPI.IN_PLACE, pressing)
    return [
        replace(result, entry=replace(result.entry, largest_pressure=p, pressing=k))
        for result, p, k in zip(results, largest.tolist(), pressing.tolist(), strict=True)
    ]


def _is_hard(contact: Contact) -> TypeGuard[ContactPair]:
    """Tell whether a contact is a pair that is not meant to be penetrated."""
    gives_way = SoftContact | RoughContact | ElasticLayer
    return isinstance(contact, ContactPair) and not isinstance(contact.law, gives_way)


def _adheres(law: NodalLaw | None) -> bool:
    """Tell whether surfaces that pull may be closed; on this rank."""
    return law is not None and bool(np.any(law.adhesion))


def _contact_result(
    contact_set: ContactSet,
    found: FoundContact,
    solution: TornSolution,
    deformed: MeshBoundary | None,
    opening: Vector,
    rows: Numbers,
    sites: Numbers,
) -> ContactResult:
    conditions, friction = found.conditions, found.along
    if deformed is not None:
        # the solution has displaced the surfaces of its conditions
        conditions = conditions.with_areas_of(deformed)
    force = solution.normal_force[rows]
    pressure = conditions.mean_traction(force)
    entry = ContactEntry(
        **vars(solution.report.contacts[found.number]),
        matching=found.undeformed.summary,
        roles_ratio=found.roles.ratio,
        roles=found.roles.reason,
    )
    return ContactResult(
        conditions.name,
        entry,
        conditions.slave,
        contact_set.dofs(conditions.slave),
        conditions.coordinates,
        found.gap,
        opening[rows],
        conditions.normal,
        nodal_normal_force=force,
        pressure=pressure,
        nominal_pressure=pressure * conditions.stretch,
        active=solution.active[rows] if _adheres(found.law) else force > 0.0,
        area=conditions.area,
        coverage=conditions.coverage,
        friction=(
            None if friction is None else _friction_result(friction, solution, sites, conditions)
        ),
        damage=None if found.law is None else found.law.damage,
        comm=contact_set.boundary.nodes.comm,
    )


def _friction_result(
    friction: NodalFriction, solution: TornSolution, sites: Numbers, conditions: ContactConditions
) -> FrictionResult:
    """Return what a solution is at these sites, the conditions of a contact. Collective."""
    # on the slave forces are against the tangents
    force, slip = solution.tangential_force[sites], solution.slip[sites]
    sticking = solution.sticking[sites]
    plastic = np.where(sticking[:, None], 0.0, slip - friction.elastic_slip(force))
    slave_force = -np.einsum("kt,kta->ka", force, friction.tangents)
    return FrictionResult(
        force=slave_force,
        traction=conditions.mean_traction(slave_force),
        bound=solution.slip_bound[sites],
        slip=np.einsum("kt,kta->ka", slip, friction.tangents),
        sticking=sticking,
        work=np.sum(force * plastic, axis=1),
    )


def _tied_result(
    contact_set: ContactSet,
    found: FoundTie,
    solution: TornSolution,
    rows: Numbers,
    shortening: float | None,
) -> TiedResult:
    """Return the result of a tie; the shortening is that of a bolt where it is an unknown."""
    tie, force = found.conditions, found.conditions.forces(solution.tied_force[rows])
    entry = ContactEntry(**vars(solution.report.contacts[found.number]), matching=tie.summary)
    if tie.preload is not None:
        tension = float(np.array(entry.force) @ tie.preload.direction)
        shortening = tie.preload.shortening if shortening is None else shortening
        entry = replace(entry, tension=tension, shortening=shortening)
    return (TiedResult if tie.preload is None else BoltResult)(
        tie.name,
        entry,
        tie.nodes,
        contact_set.dofs(tie.nodes),
        tie.coordinates,
        force,
        mean_traction(tie.boundary.nodes, tie.shares, force, tie.area),
        tie.area,
        contact_set.boundary.nodes.comm,
    )


def _body_result(
    contact_set: ContactSet, frame: BodyFrame, solution: TornSolution
) -> RigidBodyResult:
    force, moment = np.zeros(frame.body.gdim), np.zeros(frame.body.modes - frame.body.gdim)
    # each contact once, which may have several parts
    for found in {found.number: found for found in contact_set.entries}.values():
        is_obstacle = isinstance(found, FoundContact) and found.body is frame.body
        if is_obstacle or found.rigid_master is frame.body:
            entry = solution.report.contacts[found.number]
            force += entry.force_on_master
            moment += entry.moment_on_master
    return RigidBodyResult.of(frame, force, moment)
