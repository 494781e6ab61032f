"""Contacts whose pressure is a function of the approach: Newton's method on this law.

The first solve is that of hard contact. Each further one has tangents of the law, springs that
press from other gaps on: first where the law has the pressures of hard contact, then at the last
approaches. As pressures are convex functions of the approach, tangents are below them: nodes go too
deep, and come back. Where surfaces are apart the tangent is that at a negligible pressure, so that
nodes may touch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.errors import InputError, NotConverged
from fenics_tfeti.fem.contact.conditions.laws import NodalLaw
from fenics_tfeti.fem.contact.contact_set import ContactSet, FoundContact
from fenics_tfeti.fem.contact.descriptions.laws import RoughContact
from fenics_tfeti.fem.contact.solution.solved import SolvedContacts
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.user_data import scalars_at
from fenics_tfeti.parallel import largest_of_ranks, raise_collectively
from fenics_tfeti.typing import Vector

# error of pressures relative to the largest one, and limit on solves
_TOLERANCE = 1e-6
_MOST = 40
# relative to the largest pressure, where the tangent of surfaces that are apart is taken
_NEGLIGIBLE = 0.5 * _TOLERANCE
# approaches between which that of a pressure is looked for [m], and steps of bisection
_POWERS, _BISECTIONS = 2.0 ** np.arange(-60, 40), 60
_GRID = np.concatenate([-_POWERS[::-1], [0.0], _POWERS])


def solve_rough(
    contact_set: ContactSet, force: Vector, solve: Callable[[ContactSet], SolvedContacts]
) -> None:
    """Solve with the laws of rough contacts, until pressures follow them. Collective.

    Parameters
    ----------
    contact_set : ContactSet
        The conditions.
    force : (k,) array
        Normal forces of the last solution, zero without [N].
    solve : callable
        Solves with conditions, and returns the solution.

    Raises
    ------
    InputError
        If a law fails, or has pressures that do not grow from zero.
    NotConverged
        At the limit on solves.
    """
    laws = [_Law(number, found, law) for number, found, law in contact_set.rough]
    tangents = [law.at_forces(force[contact_set.positions[law.number]]) for law in laws]
    errors = [np.inf]
    for _ in range(_MOST):
        solved = solve(_with_tangents(contact_set, laws, tangents))
        errors = [law.error(tangent, solved) for law, tangent in zip(laws, tangents, strict=True)]
        if max(errors) <= _TOLERANCE:
            return
        tangents = [law.next(tangent, solved) for law, tangent in zip(laws, tangents, strict=True)]
    worst = laws[int(np.argmax(errors))].found.conditions.name
    raise NotConverged(
        f"{worst}: pressures are {max(errors):.1e} of the largest off the law of RoughContact "
        f"after {_MOST} solves. Take smaller load steps, and check that the stiffness is the "
        "derivative of the pressure, and grows with the approach"
    )


@dataclass(frozen=True)
class _Tangent:
    """The tangents of a law at the k conditions of a contact."""

    stiffness: Vector  # (k,) [Pa/m]
    touching: Vector  # gaps (k,) from which on they press [m]

    def pressure(self, approach: Vector) -> Vector:
        """Return the pressures (k,) at approaches [Pa]."""
        return np.maximum(self.stiffness * (approach + self.touching), 0.0)


def _with_tangents(
    contact_set: ContactSet, laws: Sequence[_Law], tangents: Sequence[_Tangent | None]
) -> ContactSet:
    """Return the set with tangents as the laws of contacts; without one contact is hard."""
    contacts = list(contact_set.contacts)
    for law, tangent in zip(laws, tangents, strict=True):
        if tangent is not None:
            area = law.found.conditions.area
            linear = NodalLaw.soft(tangent.stiffness * area, tangent.touching)
            contacts[law.number] = replace(law.found, law=linear)
    return replace(contact_set, contacts=contacts)


@dataclass(frozen=True)
class _Law:
    """The law of one contact at its k conditions, this rank's part. All methods are collective."""

    number: int  # among the contacts of the set
    found: FoundContact
    law: RoughContact

    def error(self, tangent: _Tangent | None, solved: SolvedContacts) -> float:
        """Return by how much a solution is off the law, over the largest pressure."""
        approach = self._approach(solved)
        pressure = self._pressure(approach)
        if tangent is None:
            presses = np.maximum(pressure, solved.contacts[self.number].nodal_normal_force)
            return np.inf if self._largest(presses) else 0.0
        misfit = self._largest(np.abs(pressure - tangent.pressure(approach)))
        return misfit / (self._largest(pressure) or misfit or 1.0)

    def next(self, tangent: _Tangent | None, solved: SolvedContacts) -> _Tangent | None:
        """Return the tangents after a solution, after hard contact at its forces."""
        if tangent is None:
            force = solved.contacts[self.number].nodal_normal_force
            if (at_forces := self.at_forces(force)) is not None:
                return at_forces
        return self._tangent(self._approach(solved))

    def at_forces(self, force: Vector) -> _Tangent | None:
        """Return the tangents where the law has the pressures of forces (k,) [N]; None without."""
        area = self.found.conditions.area
        pressure = np.divide(force, area, out=np.zeros_like(force), where=area > 0.0)
        if not (largest := self._largest(pressure)):
            return None
        return self._tangent(self._approach_at(np.maximum(pressure, _NEGLIGIBLE * largest)))

    def _tangent(self, approach: Vector) -> _Tangent | None:
        """Return the tangents at approaches (k,); None where nothing presses."""
        if not (largest := self._largest(self._pressure(approach))):
            return None
        apart = self._approach_at(np.array([_NEGLIGIBLE * largest]))
        approach = np.maximum(approach, apart)
        pressure, conditions = self._pressure(approach), self.found.conditions
        stiffness = self._values(self.law.stiffness, approach, "stiffness")
        comm, x = conditions.surface.comm, conditions.coordinates
        if bad := first_wrong(comm, ~(stiffness > 0.0), x):
            raise InputError(
                f"{conditions.name}: the stiffness of RoughContact is not positive at {bad.number} "
                f"nodes that press, the first at {bad.place}. It is the derivative of the pressure"
            )
        return _Tangent(stiffness, pressure / stiffness - approach)

    def _approach(self, solved: SolvedContacts) -> Vector:
        """Return the approaches (k,) of a solution [m], finite ones where nothing is opposite."""
        return np.maximum(-solved.contacts[self.number].opening, _GRID[0])

    def _approach_at(self, pressure: Vector) -> Vector:
        """Return the approaches (n,) of positive pressures [m]."""
        name, law = self.found.conditions.name, self.law.pressure
        with raise_collectively(self.found.conditions.surface.comm), np.errstate(over="ignore"):
            on_grid = np.asarray(law(_GRID))
            end = np.argmax(on_grid >= pressure[:, None], axis=1)
            if (end == 0).any():
                raise InputError(
                    f"{name}: the pressure of RoughContact has to grow from zero where surfaces "
                    f"are apart; it is {on_grid[0]:.3g} at the approach {_GRID[0]:.3g}, and at no "
                    f"larger one {pressure[end == 0][0]:.3g}, which contact needs"
                )
            low, high = _GRID[end - 1], _GRID[end]
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                below = np.asarray(law(middle)) < pressure
                low, high = np.where(below, middle, low), np.where(below, high, middle)
        return high

    def _pressure(self, approach: Vector) -> Vector:
        return self._values(self.law.pressure, approach, "pressure")

    def _values(self, function: Callable[[Vector], Vector], approach: Vector, name: str) -> Vector:
        """Return the values (n,) of a function of the law, checked."""
        comm, label = self.found.conditions.surface.comm, self.found.conditions.name
        label += f": the {name} of RoughContact"
        points = approach[:, None]
        return scalars_at(comm, lambda x: function(x[0]), points, 1, label, lowest=0.0)

    def _largest(self, values: Vector) -> float:
        return largest_of_ranks(self.found.conditions.surface.comm, values)
