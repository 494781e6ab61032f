"""Adhesion of limited energy, which ends where surfaces have come apart as far as it reaches.

Where it has not ended adhesion is a given force across any opening, so that a solve is one of plain
contact. Each pass ends it where the last one has opened the surfaces beyond its reach, until none
does: what ends opens others further, and passes follow a crack that runs by itself to where it
stops. Loads that grow by steps end it where smaller ones would have, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fenics_tfeti.errors import DamageNotFound, UnresistedMotion
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.conditions.laws import NodalLaw
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Mask, Vector


def solve_adhesive(
    contact_set: ContactSet,
    damage: SlaveValues | None,
    solve: Callable[[ContactSet], SolvedContacts],
) -> tuple[dict[str, float], dict[str, int]]:
    """Solve, with adhesion that ends, until no more of it does. Collective.

    Parameters
    ----------
    contact_set : ContactSet
        The conditions, with all of the adhesion.
    damage : SlaveValues or None
        1 where adhesion had ended at the end of the last load step; None in the first one.
    solve : callable
        Solves with conditions, and returns the solution.

    Returns
    -------
    dissipated, failed : dict
        By contact the energy that adhesion has taken since the last step [J], and at how many nodes
        it has ended.

    Raises
    ------
    DamageNotFound
        If bodies are free where adhesion ends.
    """
    adhesive = contact_set.adhesive
    before = [_ended_before(contact_set, found, law, damage) for _, found, law in adhesive]
    ended = _found_by_passes(contact_set, before, solve)
    energies, failures = list[tuple[FoundContact, Vector]](), list[tuple[FoundContact, Vector]]()
    for (_, found, law), first, last in zip(adhesive, before, ended, strict=True):
        assert law.reach is not None
        adheres = law.adhesion > 0.0
        taken = np.where(adheres & last & ~first, law.adhesion, 0.0)
        energies.append((found, taken * np.where(adheres, law.reach, 0.0)))
        failures.append((found, np.where(adheres & last, 1.0, 0.0)))
    failed = {name: round(number) for name, number in contact_set.sums(failures).items()}
    return contact_set.sums(energies), failed


def _found_by_passes(
    contact_set: ContactSet, before: Sequence[Mask], solve: Callable[[ContactSet], SolvedContacts]
) -> Sequence[Mask]:
    """Return where adhesion has ended (k,) at each contact that it ends at. Collective."""
    comm, ended, is_first = contact_set.boundary.nodes.comm, before, True
    while True:
        try:
            solved = solve(_with_ended(contact_set, ended))
        except UnresistedMotion as error:
            if is_first:
                raise
            raise DamageNotFound(
                "adhesion ends before the loads are reached, and leaves bodies free. Prescribe "
                "displacements in place of forces, or take smaller load steps"
            ) from error
        last, is_first = ended, False
        ended = [
            now | (law.is_beyond(solved.contacts[number].opening))
            for now, (number, _, law) in zip(last, contact_set.adhesive, strict=True)
        ]
        if not any_rank(comm, np.concatenate(ended) & ~np.concatenate(last)):
            return last


def _ended_before(
    contact_set: ContactSet, found: FoundContact, law: NodalLaw, damage: SlaveValues | None
) -> Mask:
    """Return where adhesion had ended (k,), in the first step where surfaces are far apart."""
    assert law.damage is not None
    ended = law.damage > 0.0
    if damage is None:
        return np.asarray(ended | law.is_beyond(found.conditions.gap))
    known = damage.at(found.history, contact_set.dofs(found.conditions.slave))
    return np.asarray(ended | (known > 0.0))


def _with_ended(contact_set: ContactSet, ended: Sequence[Mask]) -> ContactSet:
    """Return the set without adhesion where it has ended (k,) at each contact."""
    contacts = list(contact_set.contacts)
    for where, (number, found, law) in zip(ended, contact_set.adhesive, strict=True):
        contacts[number] = replace(found, law=law.ended(where))
    return replace(contact_set, contacts=contacts)
