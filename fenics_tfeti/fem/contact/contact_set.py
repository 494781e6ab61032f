"""All contacts and tied surfaces of a problem, as they were found at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.checks import check_depth
from fenics_tfeti.fem.contact.contact import Contact, ContactPair, ContactPairing
from fenics_tfeti.fem.contact.deformed import DeformedContact, deformed_contact
from fenics_tfeti.fem.contact.matching import contact_rows, match_contacts
from fenics_tfeti.fem.contact.opening import openings
from fenics_tfeti.fem.contact.pairing_summary import warn_of_deviation
from fenics_tfeti.fem.contact.result import ContactResult
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
from fenics_tfeti.fem.contact.tied import TiedPair, TiedPairing, tie_pairs, tied_rows
from fenics_tfeti.fem.contact.transfer import SolvedContact, gather_solved
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.feti.system import ContactRows, Friction, Prescribed, Subdomain
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

T = TypeVar("T")


@dataclass(frozen=True)
class FoundContact:
    """A contact with its conditions, of the undeformed or of the deformed surfaces."""

    given: Contact  # as the user gave it
    contact: Contact  # the same object, or the pair with exchanged roles
    pairing: ContactPairing
    undeformed: ContactPairing
    friction: NodalFriction | None = None  # at `pairing`

    @property
    def is_exchanged(self) -> bool:
        """Whether slave and master are not as the user gave them."""
        return self.contact is not self.given

    @property
    def gap(self) -> Vector:
        """Gaps of the undeformed surfaces (k,) [m]; infinite at nodes without condition there."""
        nodes, gaps = self.undeformed.slave, self.undeformed.gap
        _, rows, rows_of_gaps = np.intersect1d(self.pairing.slave, nodes, return_indices=True)
        gap = np.full(self.pairing.slave.size, np.inf)
        gap[rows] = gaps[rows_of_gaps]
        return gap


@dataclass(frozen=True)
class ContactSet:
    """Everything found at one moment: the conditions of all contacts, with friction, and ties."""

    boundary: MeshBoundary
    contacts: list[FoundContact]
    ties: list[tuple[TiedPair, TiedPairing]]
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
        """Names of the contacts, then of the tied pairs."""
        return [*(p.name for p in self.pairings), *(pairing.name for _, pairing in self.ties)]

    def rows(self) -> ContactRows:
        """Return the conditions of all contacts, one contact after the other."""
        return contact_rows(self.pairings, self.boundary.space.mesh.geometry.dim)

    def tied_rows(self) -> ContactRows:
        """Return the conditions of all tied pairs, which are numbered after the contacts."""
        gdim = self.boundary.space.mesh.geometry.dim
        return tied_rows([pairing for _, pairing in self.ties], gdim, len(self.contacts))

    def friction_rows(self, origin: SlipOrigin) -> Friction:
        """Return where `rows` have friction, and from where slip is counted. Collective."""
        return friction_rows(self.boundary.nodes, self.rows(), self.pairings, self.friction, origin)

    def obstacle_displacements(self) -> Vector:
        """Return each obstacle's displacement at the slave's nodes, as in `SlipOrigin`."""
        return obstacle_displacements(self.boundary.nodes, self.pairings, self.friction)

    def with_friction(self) -> ContactSet:
        """Return the set with friction evaluated at its conditions. Collective."""
        space = self.boundary.space
        contacts = [
            replace(
                found, friction=nodal_friction(space, found.contact, found.pairing, self.prescribed)
            )
            for found in self.contacts
        ]
        return replace(self, contacts=contacts)

    def deformed(self, uh: Function) -> tuple[ContactSet, list[DeformedContact]]:
        """Return the conditions of the deformed surfaces, and what was measured. Collective.

        Friction is still that at the conditions before, see `with_friction`.
        """
        measured = [
            deformed_contact(
                self.boundary, found.contact, found.pairing, uh, _gives_normals(found.contact)
            )
            for found in self.contacts
        ]
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
        """Return the solution at each contact. Collective."""
        space = self.boundary.space
        opening = openings(self.boundary.nodes, self.pairings, owned_values(uh))
        results, row, site = [], 0, 0
        for found, gap_after in zip(self.contacts, opening, strict=True):
            pairing, friction = found.pairing, found.friction
            rows = slice(row, row + pairing.slave.size)
            sites = slice(site, site + (0 if friction is None else friction.bound.size))
            row, site = rows.stop, sites.stop
            force = solution.normal_force[rows]
            result = ContactResult(
                pairing.name,
                pairing.slave,
                pairing.coordinates,
                found.gap,
                gap_after,
                pairing.normal,
                normal_force=force,
                pressure=force / pairing.area,
                active=force > 0.0,
                area=pairing.area,
                coverage=np.ones_like(force) if pairing.coverage is None else pairing.coverage,
                friction=friction_result(
                    friction,
                    pairing,
                    solution.tangential_force[sites],
                    solution.slip[sites],
                    solution.sticking[sites],
                    solution.slip_bound[sites],
                ),
                comm=space.mesh.comm,
            )
            results.append(result)
        return SolvedContacts(self, results, uh)

    def as_given(self, slaves: Sequence[T], masters: Sequence[T]) -> tuple[list[T], list[T]]:
        """Return something of slaves and of masters in the roles that the user gave.

        There is one entry for each contact, then one for each tied pair.
        """
        turned = [found.is_exchanged for found in self.contacts] + [False] * len(self.ties)
        pairs = list(zip(turned, slaves, masters, strict=True))
        return [m if t else s for t, s, m in pairs], [s if t else m for t, s, m in pairs]


@dataclass(frozen=True)
class SolvedContacts:
    """A solution at the contacts, with the conditions that it fulfils."""

    conditions: ContactSet
    results: list[ContactResult]  # in the roles that are used
    displacement: Function

    def as_given(self) -> list[ContactResult]:
        """Return the results in the roles that the user gave."""
        return [
            result.seen_from_master() if found.is_exchanged else result
            for found, result in zip(self.conditions.contacts, self.results, strict=True)
        ]

    def nodal_forces(self) -> Vector:
        """Return the normal forces (contacts, nodes) at the nodes that this rank owns [N]."""
        nodes = self.conditions.boundary.nodes
        force = np.zeros((len(self.results), nodes.owned))
        for values, result in zip(force, self.results, strict=True):
            values[result.nodes - nodes.first] = result.normal_force
        return force

    def gathered(self) -> list[SolvedContact]:
        """Gather the solution on the slaves' surfaces on every rank. Collective."""
        conditions = self.conditions
        contacts = [found.contact for found in conditions.contacts]
        return gather_solved(
            conditions.boundary, contacts, conditions.pairings, self.results, self.displacement
        )


class ContactSearch:
    """The search for the conditions of a problem's contacts.

    What was found is used again as long as the user's contacts and the nodes of the mesh are the
    same. It also decides, once for each pair, whether slave and master are exchanged.
    """

    def __init__(self, space: FunctionSpace, bodies: Bodies, timer: Timer) -> None:
        self._space, self._bodies, self._timer = space, bodies, timer
        self._roles: list[Roles] = []
        self.forget()

    def forget(self) -> None:
        """Find the boundary of the mesh anew, because its nodes were moved. Collective."""
        self._last: ContactSet | None = None
        with self._timer.phase("contact search"):
            self.boundary = MeshBoundary.of(self._space)

    def find(
        self, contacts: Sequence[Contact], tied: Sequence[TiedPair], prescribed: Prescribed
    ) -> ContactSet:
        """Return the undeformed conditions; only what changed is searched again. Collective."""
        with self._timer.phase("contact search"):
            used = [self._used(contact) for contact in contacts]
            last = self._last or ContactSet(self.boundary, [], [], prescribed)
            known = [(found.contact, found.undeformed) for found in last.contacts]
            pairings = match_contacts(self.boundary, used, known, prescribed)
            check_depth(self._space, self._bodies, pairings)
            found_contacts = [
                FoundContact(given, contact, pairing, pairing)
                for given, contact, pairing in zip(contacts, used, pairings, strict=True)
            ]
            ties = tie_pairs(self.boundary, tied, last.ties, prescribed)
            found = ContactSet(self.boundary, found_contacts, ties, prescribed).with_friction()
        self._last = found
        return found

    def with_roles(self, found: ContactSet, torn: Sequence[Subdomain]) -> ContactSet:
        """Exchange slave and master of new pairs where that is better and wanted, or warn."""
        comm, new = self._space.mesh.comm, []
        for number, entry in enumerate(found.contacts):
            if isinstance(entry.given, ContactPair) and self._roles_of(entry.given) is None:
                found = self._decide_roles(found, number, torn)
                new.append(number)
        with raise_collectively(comm):
            for number in new if comm.rank == 0 else ():
                warn_of_deviation(found.contacts[number].undeformed.summary)
        return found

    def pairing_entries(self, found: ContactSet) -> list[dict[str, Any]]:
        """Return the pairing of each contact and tied pair in numbers, for the report."""
        undecided = {"roles_ratio": None, "roles": None}
        entries = []
        for entry in found.contacts:
            roles = self._roles_of(entry.given)
            decision = undecided if roles is None else roles.entries()
            entries.append({**entry.undeformed.summary, **decision})
        return entries + [pairing.summary for _, pairing in found.ties]

    def _roles_of(self, contact: Contact) -> Roles | None:
        return next((roles for roles in self._roles if roles.given is contact), None)

    def _used(self, contact: Contact) -> Contact:
        roles = self._roles_of(contact)
        return contact if roles is None else roles.used

    def _decide_roles(
        self, found: ContactSet, number: int, torn: Sequence[Subdomain]
    ) -> ContactSet:
        """Decide the roles of one pair, and find all conditions anew if they are exchanged."""
        comm, entry = self._space.mesh.comm, found.contacts[number]
        pair, pairing = entry.given, entry.undeformed
        assert isinstance(pair, ContactPair)
        ratio = roles_ratio(comm, pairing, torn)
        roles = Roles(pair, pair, ratio, describe_roles(pair, ratio, False, None))
        if ratio is not None and prefers_exchange(pair, ratio):
            reason = describe_roles(pair, ratio, True, None)
            self._roles.append(Roles(pair, exchanged(pair), 1.0 / ratio, reason))
            try:
                found = self.find(
                    [c.given for c in found.contacts],
                    [tied for tied, _ in found.ties],
                    found.prescribed,
                )
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
        return found


def _gives_normals(contact: Contact) -> bool:
    return isinstance(contact, ContactPair) and contact.normal is not None
