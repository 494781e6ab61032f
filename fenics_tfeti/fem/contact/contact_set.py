"""All contacts and tied surfaces of a problem, as they were found at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.checks import check_depth
from fenics_tfeti.fem.contact.contact import ContactPairing, contact_rows, openings
from fenics_tfeti.fem.contact.deformed import DeformedContact, deformed_contact
from fenics_tfeti.fem.contact.description import Contact, ContactPair, TiedPair
from fenics_tfeti.fem.contact.matching import match_contacts
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.result import ContactEntry, ContactResult, Results, TiedResult
from fenics_tfeti.fem.contact.roles import (
    Roles,
    describe_roles,
    exchanged,
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
from fenics_tfeti.fem.contact.tied import TiedPairing, tie_pairs, tied_rows
from fenics_tfeti.fem.contact.transfer import SolvedContact, gather_solved
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import owned_values
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

    def measured(self, uh: Function) -> DeformedContact:
        """Measure normals, gaps and penetration in the deformed state. Collective."""
        return deformed_contact(self.contact, self.pairing, uh)

    def with_friction(self, space: FunctionSpace, prescribed: Prescribed) -> FoundContact:
        """Return the contact with friction evaluated at its conditions. Collective."""
        friction = nodal_friction(space, self.contact, self.pairing, prescribed)
        return replace(self, friction=friction)


@dataclass(frozen=True)
class FoundTie:
    """A tied pair with its conditions."""

    number: int  # among all contacts and tied pairs
    pair: TiedPair
    pairing: TiedPairing


@dataclass(frozen=True)
class ContactSet:
    """Everything found at one moment: the conditions of all contacts, with friction, and ties."""

    boundary: MeshBoundary
    contacts: list[FoundContact]
    ties: list[FoundTie]
    prescribed: Prescribed  # the supports that they were found with

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
        rows = contact_rows(self.pairings, self.boundary.space.mesh.geometry.dim)
        return _numbered(rows, self.contacts)

    def tied_rows(self) -> ContactRows:
        """Return the conditions of all tied pairs, the components of a pair one after the other."""
        gdim = self.boundary.space.mesh.geometry.dim
        return _numbered(tied_rows([tie.pairing for tie in self.ties], gdim), self.ties)

    def friction_rows(self, origin: SlipOrigin) -> Friction:
        """Return where `rows` have friction, and from where slip is counted. Collective."""
        return friction_rows(self.boundary.nodes, self.rows(), self.pairings, self.friction, origin)

    def obstacle_displacements(self) -> Vector:
        """Return each obstacle's displacement at the slave's nodes, as in `SlipOrigin`."""
        return obstacle_displacements(self.boundary.nodes, self.pairings, self.friction)

    def with_friction(self) -> ContactSet:
        """Return the set with friction evaluated at its conditions. Collective."""
        space = self.boundary.space
        contacts = [found.with_friction(space, self.prescribed) for found in self.contacts]
        return replace(self, contacts=contacts)

    def deformed(self, uh: Function) -> tuple[ContactSet, list[DeformedContact]]:
        """Return the conditions of the deformed surfaces, and what was measured. Collective.

        Friction is still that at the conditions before, see `with_friction`.
        """
        measured = [found.measured(uh) for found in self.contacts]
        contacts = [
            replace(found, pairing=new.pairing(found.pairing))
            for found, new in zip(self.contacts, measured, strict=True)
        ]
        return replace(self, contacts=contacts), measured

    def has_same_contacts(self, other: ContactSet) -> bool:
        """Tell whether another set was found for the same contacts in the same roles."""
        return len(self.contacts) == len(other.contacts) and all(
            a.contact is b.contact for a, b in zip(self.contacts, other.contacts, strict=True)
        )

    def at_conditions_of(self, other: ContactSet) -> ContactSet:
        """Return the set with the conditions of another one for the same contacts. Collective."""
        contacts = [
            replace(found, pairing=earlier.pairing)
            for found, earlier in zip(self.contacts, other.contacts, strict=True)
        ]
        return replace(self, contacts=contacts).with_friction()

    def solved(self, solution: TornSolution, uh: Function) -> SolvedContacts:
        """Return the solution at each contact and tied pair. Collective."""
        opening = openings(self.boundary.nodes, self.pairings, owned_values(uh))
        contacts, ties, row, site = [], [], 0, 0
        for found, gap_after in zip(self.contacts, opening, strict=True):
            rows = slice(row, row + found.pairing.slave.size)
            sites = slice(site, site + (0 if found.friction is None else rows.stop - row))
            row, site = rows.stop, sites.stop
            contacts.append(self._result(found, gap_after, solution, rows, sites))
        row = 0
        for tie in self.ties:
            rows = slice(row, row + sum(part.slave.size for part in tie.pairing.components))
            row = rows.stop
            forces = solution.report.contacts[tie.number]
            ties.append(self._tied_result(tie.pairing, forces, solution.tied_force[rows]))
        return SolvedContacts(self, contacts, ties, uh)

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

    def _tied_result(self, tie: TiedPairing, forces: ContactForces, rows: Vector) -> TiedResult:
        """Return the result of a tied pair from the forces of its rows, component by component."""
        nodes = np.unique(np.concatenate([part.slave for part in tie.components]))
        force, area = np.zeros((nodes.size, len(tie.components))), np.zeros(nodes.size)
        begin = 0
        for component, part in enumerate(tie.components):
            position = np.searchsorted(nodes, part.slave)
            # the force of a row acts on the slave against its direction
            force[position, component] = -rows[begin : begin + part.slave.size]
            area[position] = part.area
            begin += part.slave.size
        surface = tie.surface
        return TiedResult(
            tie.name,
            ContactEntry(**vars(forces), pairing=tie.summary),
            nodes,
            self._dofs(nodes),
            surface.coordinates[np.searchsorted(surface.nodes, nodes)],
            force,
            force / area[:, None],
            area,
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

    def find(self, contacts: Sequence[Contact | TiedPair], prescribed: Prescribed) -> ContactSet:
        """Return the undeformed conditions; only what changed is searched again. Collective."""
        touching, tied = dict[int, Roles](), dict[int, TiedPair]()
        for number, contact in enumerate(contacts):
            if isinstance(contact, TiedPair):
                tied[number] = contact
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
                FoundContact(number, roles, pairing, pairing)
                for (number, roles), pairing in zip(touching.items(), pairings, strict=True)
            ]
            ties = tie_pairs(
                self.boundary, tied, [(tie.pair, tie.pairing) for tie in last.ties], prescribed
            )
            found_ties = [FoundTie(number, tied[number], ties[number]) for number in tied]
            found = ContactSet(self.boundary, found_contacts, found_ties, prescribed)
            found = found.with_friction()
        self._last = found
        return found

    def with_roles(
        self, found: ContactSet, contacts: Sequence[Contact | TiedPair], torn: Sequence[Subdomain]
    ) -> ContactSet:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm = self._space.mesh.comm
        new = [
            index
            for index, entry in enumerate(found.contacts)
            if isinstance(entry.contact, ContactPair) and self._roles_of(entry.roles.given) is None
        ]
        for index in new:
            found = self._decide_roles(found, index, contacts, torn)
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
        contacts: Sequence[Contact | TiedPair],
        torn: Sequence[Subdomain],
    ) -> ContactSet:
        """Decide the roles of one pair, and find all conditions anew if they are exchanged."""
        comm, entry = self._space.mesh.comm, found.contacts[index]
        pair, pairing = entry.roles.given, entry.undeformed
        assert isinstance(pair, ContactPair)
        ratio = roles_ratio(pairing, torn)
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


def _numbered(rows: ContactRows, found: Sequence[FoundContact | FoundTie]) -> ContactRows:
    """Return rows, counted contact by contact, with the numbers of the contacts."""
    numbers = np.array([entry.number for entry in found], dtype=np.int64)
    return replace(rows, contact=numbers[rows.contact])
