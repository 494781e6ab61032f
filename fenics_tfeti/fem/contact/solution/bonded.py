"""The bonds of all contacts that can break, on all ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.fem.contact.conditions.bonds import Bonds
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact, consecutive
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
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

    def jumps(self, solved: SolvedContacts) -> Array:
        """Return the jumps (k, 1 + gdim) of a solution at its contacts. Collective."""
        own, contact_set = list[Array](), solved.contact_set
        results = dict(zip(contact_set.keys, solved.contacts, strict=True))
        for found, bonds, _ in contact_set.bonded:
            result = results[found.key]
            opening, slip = result.opening, np.zeros_like(result.normal)
            opening = np.where(np.isfinite(opening), np.maximum(opening, 0.0), 0.0)
            if result.friction is not None:
                along = bonds.shear_strength > 0.0
                slip = np.where(along[:, None], result.friction.slip, 0.0)
            own.append(np.column_stack([opening, slip]))
        return concatenate_ranks(contact_set.boundary.nodes.comm, np.concatenate(own))

    def by_contact(self, values: Vector) -> dict[str, float]:
        """Return the sums of values (k,) by the names of contacts. Collective."""
        contacts = [found for found, *_ in self.contact_set.bonded]
        return self.contact_set.sums(list(zip(contacts, self._split(values), strict=True)))

    def _split(self, values: Array) -> Sequence[Array]:
        """Return the values of each contact on this rank."""
        sizes = [damage.size for *_, damage in self.contact_set.bonded]
        return [values[self.first + part] for part in consecutive(sizes)]
