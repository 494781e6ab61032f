"""The bonds of all contacts that can break, on all ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.fem.contact.conditions.bonds import Bonds
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact, consecutive
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank, positions
from fenics_tfeti.typing import Array, Vector


@dataclass(frozen=True)
class BondedContacts:
    """The contacts with bonds; vectors (k,) are those of all ranks, the same on each of them."""

    contact_set: ContactSet
    bonds: Bonds
    before: Vector  # (k,): damage of the last load step
    first: int  # of this rank's bonds

    @staticmethod
    def of(contact_set: ContactSet, damage: SlaveValues) -> BondedContacts | None:
        """Return the bonds of a set with the damage of a load step; None without. Collective."""
        if not contact_set.bonded:
            return None
        comm = contact_set.boundary.nodes.comm
        columns, before = list[Array](), list[Vector]()
        for found, bonds, intact in contact_set.bonded:
            known = damage.at(found.history, contact_set.dofs(found.conditions.slave))
            columns.append(bonds.columns())
            before.append(np.maximum(intact, known))
        size = sum(part.size for part in before)
        return BondedContacts(
            contact_set,
            Bonds.from_columns(concatenate_ranks(comm, np.concatenate(columns))),
            concatenate_ranks(comm, np.concatenate(before)),
            first_of_rank(comm, size)[0],
        )

    def with_damage(self, damage: Vector) -> ContactSet:
        """Return the set with a damage (k,) of its bonds."""
        parts, contacts = iter(self._split(damage)), list[FoundContact]()
        for found in self.contact_set.contacts:
            if found.law is not None and found.law.bonds is not None:
                found = replace(found, law=found.law.damaged(next(parts)))
            contacts.append(found)
        return replace(self.contact_set, contacts=contacts)

    def damage_at_nodes(self, damage: Vector) -> SlaveValues:
        """Return a damage (k,) by the slave nodes of this rank."""
        found = [found for found, *_ in self.contact_set.bonded]
        nodes = (self.contact_set.dofs(f.conditions.slave) for f in found)
        parts = zip(nodes, self._split(damage), strict=True)
        return SlaveValues.of([f.history for f in found], parts)

    def jumps(self, solved: SolvedContacts) -> Array:
        """Return the jumps (k, 1 + gdim) of a solution at its contacts. Collective.

        Nodes that are opposite nothing, as their surface has turned away, are infinitely far apart.
        """
        own, comm = list[Array](), self.contact_set.boundary.nodes.comm
        results = dict(zip(solved.contact_set.keys, solved.contacts, strict=True))
        for found, bonds, _ in self.contact_set.bonded:
            result, friction = results[found.key], results[found.key].friction
            slip = np.zeros_like(result.normal) if friction is None else friction.slip
            solved_jumps = np.column_stack([np.maximum(result.opening, 0.0), slip])
            far = np.append(np.inf, np.zeros(slip.shape[1]))
            place = positions(result.nodes, found.conditions.slave)
            jump = np.concatenate([solved_jumps, far[None]])[place]
            holds = np.column_stack([bonds.bonded, *[bonds.shear_strength > 0.0] * slip.shape[1]])
            own.append(np.where(holds, jump, 0.0))
        return concatenate_ranks(comm, np.concatenate(own))

    def failed(self, damage: Vector) -> dict[str, int]:
        """Return the numbers of bonds without anything left, by the names of contacts. Collective.

        They are of a damage (k,).
        """
        failed = np.where(self.bonds.bonded & (damage >= 1.0), 1.0, 0.0)
        return {name: round(number) for name, number in self.by_contact(failed).items()}

    def by_contact(self, values: Vector) -> dict[str, float]:
        """Return the sums of values (k,) by the names of contacts. Collective."""
        contacts = [found for found, *_ in self.contact_set.bonded]
        return self.contact_set.sums(list(zip(contacts, self._split(values), strict=True)))

    def _split(self, values: Array) -> Sequence[Array]:
        """Return the values of each contact on this rank."""
        sizes = [damage.size for *_, damage in self.contact_set.bonded]
        return [values[self.first + part] for part in consecutive(sizes)]
