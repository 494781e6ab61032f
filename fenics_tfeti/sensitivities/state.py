"""A solved problem as its derivatives see it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import row_values
from fenics_tfeti.fem.contact.conditions.friction import SlipOrigin
from fenics_tfeti.fem.contact.conditions.ties import TiedConditions
from fenics_tfeti.fem.contact.contact_set import (
    ContactSet,
    FoundContact,
    FoundTie,
    consecutive,
)
from fenics_tfeti.fem.contact.descriptions.contacts import (
    Contact,
    ContactPair,
)
from fenics_tfeti.fem.contact.descriptions.partners import Nearest
from fenics_tfeti.fem.contact.descriptions.ties import BoltPreload, PeriodicPair, Tie
from fenics_tfeti.fem.contact.rigid.frames import RigidBodies
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.displacement import fill_displacement
from fenics_tfeti.fem.torn_problem import TornProblem
from fenics_tfeti.feti.solution.linear import LinearProblem, LinearSolution
from fenics_tfeti.feti.solver import TornSolution
from fenics_tfeti.feti.system import Friction, RowValues, TornSystem
from fenics_tfeti.parallel import (
    any_rank,
    largest_of_ranks,
)
from fenics_tfeti.sensitivities.forms import (
    FormsAtSolution,
)
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class DifferentiatedState(ABC):
    """The solved problem, as far as all derivatives need it."""

    torn: TornProblem
    forms: FormsAtSolution
    is_current: Callable[[], bool]  # whether the problem is as it was solved, on all ranks

    @property
    @abstractmethod
    def contact_set(self) -> ContactSet:
        """The conditions of contacts and ties."""

    @property
    @abstractmethod
    def friction(self) -> Friction:
        """Friction at its sites."""

    @property
    @abstractmethod
    def normal_force(self) -> Vector:
        """The normal forces (rows,) [N]."""

    @property
    def areas(self) -> Vector:
        """The areas (rows,) that belong to contact rows [m^2 or m]."""
        parts = (conditions.area for conditions in self.contact_set.all_conditions)
        return np.concatenate([np.zeros(0), *parts])

    def check_current(self) -> None:
        """Check that the problem is as it was solved. Collective."""
        if not self.is_current():
            raise InputError(
                "the problem was solved again, or its data have changed, since these derivatives "
                "were made: take them anew after solve()"
            )

    def size_of_mesh(self) -> float:
        """Return the longest edge of the box around the mesh [m]. Collective."""
        x, comm = self.torn.nodes.coordinates, self.torn.nodes.comm
        return max(
            largest_of_ranks(comm, column) + largest_of_ranks(comm, -column) for column in x.T
        )

    def used(self, contact: Contact | Tie, keep_pairs: bool = False) -> Contact | Tie:
        """Return a contact in the roles in which it is used, which stay; maybe with its partners.

        Pairs of nodes become mortar conditions where nodes of one side alone move, by default.
        """
        for found in self.contact_set.contacts:
            if found.roles.given is contact and isinstance(found.contact, ContactPair):
                partners = found.contact.partners
                if keep_pairs and partners is None and not found.conditions.is_mortar:
                    partners = Nearest()
                return replace(found.contact, roles="given", partners=partners)
        return contact

    @property
    def matched_ties(self) -> dict[int, TiedConditions]:
        """The ties, by number, of nodes that match: one alone cannot move."""
        return {
            found.number: found.conditions
            for found in self.contact_set.ties
            if isinstance(found.tie, PeriodicPair | BoltPreload)
        }

    def parts_of(self, name: str | int) -> list[tuple[FoundContact, Numbers]]:
        """Return the parts of a contact, by name or number, in order, with their rows."""
        return parts_of_contact(self.contact_set, name)

    def rows_of(self, name: str | int) -> Numbers:
        """Return the rows of a contact."""
        return rows_of_contact(self.contact_set, name)

    def tie_of(self, name: str | int) -> tuple[FoundTie, Numbers] | None:
        """Return a tie, by name or number, with its rows among those of all ties; None for none."""
        sizes = [found.conditions.rows.size for found in self.contact_set.ties]
        for found, own in zip(self.contact_set.ties, consecutive(sizes), strict=True):
            if name in (found.number, found.conditions.name):
                return found, own
        return None

    def check_kinds(self, found: ContactSet) -> None:
        """Check that conditions have the kinds of the undeformed ones. Collective."""

        def kinds(contact_set: ContactSet) -> list[tuple[bool, int]]:
            contacts = [(p.is_mortar, p.gap.size) for p in contact_set.all_conditions]
            return contacts + [
                (t.conditions.is_mortar, t.conditions.rows.size) for t in contact_set.ties
            ]

        if found.rough:
            raise InputError(
                f"{found.rough[0][1].conditions.name}: derivatives by nodes and obstacles know no "
                "law RoughContact. Difference solves"
            )
        if any_rank(self.torn.nodes.comm, [kinds(found) != kinds(self.torn.undeformed)]):
            raise InputError(
                "the conditions of contacts or ties are others after the change, so J jumps there: "
                "name the kind of conditions by partners, or take a smaller step"
            )

    def sites_of(self, name: str | int) -> Numbers:
        """Return the sites of friction of a contact's rows."""
        if any(contact.friction is None for contact, _ in self.parts_of(name)):
            raise InputError(f"contact {name!r} has no friction")
        site = np.full(self.normal_force.size, -1)
        site[self.friction.row] = np.arange(self.friction.size)
        return site[self.rows_of(name)]


@dataclass(frozen=True)
class SolvedState(DifferentiatedState):
    """A solved problem with the linear problem on its last face."""

    solved: SolvedContacts
    solution: TornSolution
    linear: LinearProblem
    origin: SlipOrigin

    @property
    def contact_set(self) -> ContactSet:
        """The conditions of contacts and ties."""
        return self.solved.contact_set

    @property
    def friction(self) -> Friction:
        """Friction at its sites."""
        return self.linear.system.friction

    @property
    def normal_force(self) -> Vector:
        """The normal forces (rows,) [N]."""
        return self.solution.normal_force

    @property
    def rows(self) -> Numbers:
        """The contact row of each site of friction."""
        return self.linear.system.friction.row

    @property
    def coefficient(self) -> Vector:
        """Coulomb's coefficient at sites that slip, (sites,); 0 elsewhere."""
        return np.where(self.slipping, np.asarray(self.linear.system.friction.coefficient), 0.0)

    def has_coulomb(self) -> bool:
        """Tell whether any rank has a site that slips with Coulomb's law. Collective."""
        return any_rank(self.torn.nodes.comm, self.coefficient > 0.0)

    @property
    def slipping(self) -> Mask:
        """Which sites slip."""
        return ~self.linear.sticking & (self.solution.slip_bound > 0.0)

    @property
    def direction(self) -> Vector:
        """Unit vectors along the friction forces of sites that slip, (sites, gdim - 1)."""
        force = self.solution.tangential_force
        size = np.linalg.norm(force, axis=1, keepdims=True)
        along = np.divide(force, size, out=np.zeros_like(force), where=size > 0.0)
        return np.where(self.slipping[:, None], along, 0.0)

    def zeros(self) -> RowValues:
        """Return zeros at all conditions."""
        return RowValues.zeros(self.linear.system)

    def kinks(self) -> dict[str, tuple[int, int]]:
        """Return numbers of nodes that touch without a force, and of sites at the edge of slip.

        By contact, without those that have none. Collective.
        """
        touching, at_edge = self.linear.kinks()
        at_row = np.zeros(touching.size, dtype=bool)
        at_row[self.rows] = at_edge
        found, names = self.contact_set, self.contact_set.names
        counts = np.zeros((len(names), 2), dtype=np.int64)
        for contact, own in zip(found.contacts, found.positions, strict=True):
            counts[contact.number] += [np.count_nonzero(x[own]) for x in (touching, at_row)]
        counts = self.torn.nodes.comm.allreduce(counts)
        return {
            name: (int(nodes), int(sites))
            for name, (nodes, sites) in zip(names, counts, strict=True)
            if nodes or sites
        }

    def torn_loads(self, values: Vector) -> list[Vector]:
        """Return nodal forces (n,) at one copy of each node, and on rigid bodies. Collective."""
        nodes, bodies = self.torn.nodes, self.contact_set.bodies
        forces, loads = values.reshape(-1, nodes.components), []
        given = np.zeros(nodes.size, dtype=bool)
        given[nodes.owned :] = True
        for subdomain in self.torn.torn.subdomains:
            local = nodes.to_local(subdomain.nodes)
            load = np.zeros((local.size, nodes.components))
            new = ~given[local]
            load[new] = forces[local[new]]
            given[local] = True
            loads.append(load.ravel())
        of_bodies = self.torn.resultants(values, bodies)
        loaded, unloaded = (
            bodies.loaded(x).subdomains() for x in (of_bodies, np.zeros_like(of_bodies))
        )
        loads += [s.load - t.load for s, t in zip(loaded, unloaded, strict=True)]
        return loads + [np.zeros_like(s.load) for s in self.linear.system.subdomains[len(loads) :]]

    def jumps(self, values: Vector, bodies: RigidBodies | None = None) -> RowValues:
        """Return N u, T u and tied sums of nodal values (n,). Collective.

        Rigid bodies are where they are, by default at rest.
        """
        system, nodes = self.linear.system, self.torn.nodes
        moved = None if bodies is None else bodies.free_displacements(nodes.total)
        normal, tied = (
            row_values(nodes, rows, values, moved) / rows.length
            for rows in (system.contacts, system.tied)
        )
        tangential = np.zeros((self.rows.size, system.gdim - 1))
        if any_rank(nodes.comm, [self.rows.size > 0]):
            rows = system.friction.tangential_rows(system.contacts)
            tangential = (row_values(nodes, rows, values, moved) / rows.length).reshape(
                tangential.shape
            )
        return RowValues(normal, tangential, tied)

    def nodal_forces(self, system: TornSystem, forces: RowValues) -> Vector:
        """Return N'a + T'b and those of ties (n,) at nodes that this rank owns. Collective."""
        nodes = self.torn.nodes
        total = np.zeros((nodes.owned, nodes.components))
        for numbers, terms in self._terms(system, forces):
            in_mesh = numbers < nodes.total
            total += nodes.reduce_at_owners(numbers[in_mesh], terms[in_mesh])
        return total.ravel()

    def body_forces(self, system: TornSystem, forces: RowValues) -> Vector:
        """Return N'a + T'b (b, gdim) at the nodes beyond those of the mesh. Collective."""
        nodes, bodies = self.torn.nodes, self.contact_set.bodies
        total = np.zeros_like(bodies.free_displacements(nodes.total))
        for numbers, terms in self._terms(system, forces):
            beyond = (numbers >= nodes.total) & (numbers < nodes.total + len(total))
            np.add.at(total, numbers[beyond] - nodes.total, terms[beyond])
        return np.asarray(nodes.comm.allreduce(total))

    def _terms(self, system: TornSystem, forces: RowValues) -> list[tuple[Numbers, Vector]]:
        """Return nodes (t,) and their forces (t, gdim) by contact, tied and friction rows."""
        parts = [(system.contacts, forces.normal), (system.tied, forces.tied)]
        # sums of them are collective, also for ranks without sites
        if any_rank(self.torn.nodes.comm, [system.friction.size > 0]):
            tangential = system.friction.tangential_rows(system.contacts)
            parts.append((tangential, forces.tangential.ravel()))
        return [
            (rows.nodes, (values / rows.length)[rows.row][:, None] * rows.coefficients)
            for rows, values in parts
        ]

    def displacement(self, solution: LinearSolution, name: str) -> tuple[Function, list[Vector]]:
        """Return the displacement of a linear solution, and the motions of rigid bodies."""
        u = Function(self.forms.u.function_space, name=name)
        fill_displacement(u, self.torn.torn.subdomains, solution.displacements)
        bodies, none = self.contact_set.bodies, [np.zeros_like(x) for x in solution.displacements]
        after, before = (self.contact_set.motions_after(x) for x in (solution.displacements, none))
        motions = [x - y for x, y in zip(after, before, strict=True)]
        return self.torn.fill(u, bodies.moved(motions), is_small=True), motions


def parts_of_contact(
    contact_set: ContactSet, name: str | int
) -> list[tuple[FoundContact, Numbers]]:
    """Return the parts of a contact, by name or number, in order, with their rows."""
    found = contact_set.contacts
    parts = [
        (contact, own)
        for contact, own in zip(found, contact_set.positions, strict=True)
        if name in (contact.number, contact.conditions.name)
    ]
    if not parts:
        names = sorted({contact.conditions.name for contact in found})
        raise InputError(f"there is no contact {name!r}; there are {names}")
    return parts


def rows_of_contact(contact_set: ContactSet, name: str | int) -> Numbers:
    """Return the rows of a contact."""
    return np.concatenate([own for _, own in parts_of_contact(contact_set, name)])


def sides_of_contact(contact_set: ContactSet, name: str | int) -> Vector:
    """Return 1 for each row of a contact; -1 where slave and master were exchanged."""
    return np.concatenate(
        [
            np.full(own.size, 1.0 if contact.roles.used is contact.roles.given else -1.0)
            for contact, own in parts_of_contact(contact_set, name)
        ]
    )


def weights_of_contact(
    contact_set: ContactSet, name: str | int, given: Any, shape: tuple[int, ...], label: str
) -> tuple[Numbers, Vector]:
    """Return the rows of a contact, and values (k, ...) given for them or one for all."""
    own = rows_of_contact(contact_set, name)
    weights, whole = np.asarray(given, dtype=float), (own.size, *shape)
    if weights.shape not in (whole, shape):
        raise InputError(f"{label} has the shape {weights.shape}; {whole} or {shape} expected")
    return own, np.broadcast_to(weights, whole)
