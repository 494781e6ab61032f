"""Coulomb's law of friction by a fixed point on the slip bounds.

repeat
lambda   solution with the bounds r (Tresca), to a tolerance that follows the change of r
r        bound + coefficient * lambda_N
stop     when the forces fulfil the law with the bounds that they make themselves

The map contracts where the coefficient is small enough. Where it does not, the iterations end with
the ratio of their changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import UnresistedMotion
from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.constraints.friction import SlipBound
from fenics_tfeti.feti.dual.iterate import Iterate, SolveStatus
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.outer import iterate_until_certified
from fenics_tfeti.feti.solution.setup import DualSetup
from fenics_tfeti.feti.solution.states import (
    Candidate,
    ContactData,
    Outcome,
    SlipBoundStep,
)
from fenics_tfeti.feti.timer import Timer
from fenics_tfeti.feti.tolerances import CERTIFIED
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Vector

# tolerance of the first solution, and of later ones relative to the last change of the bounds
_FIRST_RTOL, _INEXACT = 1e-2, 0.05
# the smallest tolerance of a solution, relative to the one asked for, and where that is small
_FINER, _FINEST = 0.1, 1e-9
# change below this part of the tolerance: nothing was iterated
_NOTHING = 1e-3
# the fixed point does not contract if so many steps reduce its changes by less than the ratio each
_STEPS, _RATIO = 15, 0.9
# limits on the steps, and on halvings of one whose bounds could not hold the load
_MAX_STEPS, _MAX_HALVINGS = 100, 30
# growth of the changes above which the last one was small by chance
_SUDDEN = 3.0
# normal forces for the first bounds, relative to those of a feasible start at its limit
_AMPLE = 2.0
# lengths of a step of the fixed point
_SHORTEST, _LONG, _LONGEST = 0.1, 3.0, 10.0


def iterate_slip_bounds(
    setup: DualSetup,
    data: ContactData,
    start: Iterate | None,
    options: Options,
    timer: Timer,
    monitor: Monitor,
    body_names: Sequence[str],
    balance: Callable[[SlipBound], Vector],
) -> Outcome:
    """Solve the dual problem with slip bounds that depend on the normal forces.

    Parameters
    ----------
    setup, data, start, options, timer, monitor, body_names
        As those of `iterate_until_certified`.
    balance : callable
        The feasible start for given bounds; raises `UnresistedMotion`.

    Returns
    -------
    Outcome
        The last candidate; the certificate has the error of the slip bounds.
    """
    comm = setup.constraints.layout.comm
    if not comm.allreduce(bool(data.bound.slope.any()), MPI.LOR):
        return iterate_until_certified(setup, data, start, options, timer, monitor, body_names)
    loop = _FixedPoint(setup, data, balance)
    data = loop.first(start)
    state, rtol = start, max(options.rtol, _FIRST_RTOL)
    changes = list[float]()
    products = monitor.history.products
    finest = max(_FINER * options.rtol, min(options.rtol, _FINEST))
    for _ in range(_MAX_STEPS):
        before = products.total
        inner = replace(options, rtol=rtol)
        outcome = iterate_until_certified(setup, data, state, inner, timer, monitor, body_names)
        following = loop.bound(outcome.candidate.multipliers)
        change = loop.error(outcome.candidate, following)
        if change <= _NOTHING * rtol:
            # a solution that is the last one says nothing about the map
            changes.clear()
        ratio = change / changes[-1] if changes else None
        if change > _NOTHING * rtol:
            changes.append(change)
        monitor.tell(SlipBoundStep(products.total - before, change, ratio, rtol))
        outcome = _with_error(outcome, change)
        certified = outcome.candidate.certificate.worst <= max(options.rtol, CERTIFIED)
        if certified and not outcome.converged:
            # rounding is larger than the tolerance of the step, which is finer
            return replace(outcome, status=SolveStatus.SOLVED, reason="converged")
        if not outcome.converged or (change <= options.rtol and rtol <= options.rtol):
            return outcome
        if interruption.agreed():
            return replace(outcome, status=SolveStatus.INTERRUPTED, reason="interrupted")
        reason = _failure(changes)
        if reason:
            return replace(outcome, status=SolveStatus.STALLED, reason=reason)
        data, held = loop.step(data, following)
        if not held:
            reason = "no slip bounds near those of the last step can hold the load"
            return replace(outcome, status=SolveStatus.STALLED, reason=reason)
        state = loop.moved(outcome, data.radius)
        least = options.rtol if change <= options.rtol else finest
        rtol = max(least, min(rtol, _INEXACT * change))
    reason = f"limit of {_MAX_STEPS} steps of Coulomb's law"
    return replace(outcome, status=SolveStatus.OUT_OF_STEPS, reason=reason)


def _failure(changes: Sequence[float]) -> str:
    """Return why the fixed point is given up; nothing if it goes on."""
    last = len(changes) - 1
    if last >= _STEPS and changes[last] > _RATIO**_STEPS * changes[last - _STEPS] > 0.0:
        ratio = (changes[last] / changes[last - _STEPS]) ** (1.0 / _STEPS)
        return (
            f"the slip bounds of Coulomb's law do not converge: their changes are reduced by a "
            f"factor of {ratio:.2f} a step only, and are {changes[last]:.1e} of the bounds. The "
            "coefficient of friction may be too large for a unique solution, or too small to hold "
            "the load"
        )
    return ""


def _with_error(outcome: Outcome, error: float) -> Outcome:
    certificate = replace(outcome.candidate.certificate, slip_bound_error=error)
    return replace(outcome, candidate=replace(outcome.candidate, certificate=certificate))


class _FixedPoint:
    """The map from slip bounds to those that the solution makes."""

    def __init__(
        self, setup: DualSetup, data: ContactData, balance: Callable[[SlipBound], Vector]
    ) -> None:
        self._given, self._balance = data, balance
        self._last: Vector | None = None
        self._length = 1.0
        self._friction, self._layout = setup.constraints.friction, setup.constraints.layout

    def bound(self, multipliers: Vector) -> Vector:
        """Return the bounds r that normal forces make. Collective."""
        pressing = self._friction.pressing(multipliers, self._layout)
        return self._given.bound.at(pressing)

    def first(self, start: Iterate | None) -> ContactData:
        """Return the data with the bounds of a start that can hold the load. Collective."""
        if start is not None:
            found = self._held(self.bound(start.multipliers))
            if found is not None:
                return found
        feasible = self._given.feasible
        radius = self.bound(feasible)
        limited = (radius > 0.0) & ~balls.inside(self._friction.at_sites(feasible), radius)
        if self._layout.comm.allreduce(bool(limited.any()), MPI.LOR):
            # these bounds may hold the load just so, and the motion at the limit is not unique
            radius = self.bound(_AMPLE * feasible)
        return replace(self._given, radius=radius)

    def step(self, data: ContactData, radius: Vector) -> tuple[ContactData, bool]:
        """Return the data with new bounds, or bounds on the way there that hold the load.

        The length of the step follows from the differences of the last two by Aitken's method for
        vectors (Irons, Tuck 1969). Collective.
        """
        scale, longest = self._friction.scale, min(max(_LONG, 2.0 * self._length), _LONGEST)
        way = scale * (radius - data.radius)
        if self._last is not None:
            turn = way - self._last
            turn2 = self._dot(turn, turn)
            if turn2 > 0.0:
                self._length *= -self._dot(self._last, turn) / turn2
            if self._length <= 0.0:
                # bounds that grow more and more: the sooner the better where all sticks in the end
                sudden = self._dot(way, way) > _SUDDEN**2 * self._dot(self._last, self._last)
                self._length = longest = 1.0 if sudden else _LONGEST
        self._length = min(max(self._length, _SHORTEST), longest)
        self._last, part, halved = way, self._length, False
        for _ in range(_MAX_HALVINGS):
            bounds = np.maximum(data.radius + part * way / scale, 0.0)
            # no parts of bounds where nothing presses any more: they would have large curvatures
            found = self._held(np.where(radius > 0.0, bounds, 0.0))
            if found is not None and (part == self._length or halved):
                return found, True
            # bounds that hold the load just so have no unique motion: once more than needed
            part, halved = 0.5 * part, found is not None
        return data, False

    def _held(self, radius: Vector) -> ContactData | None:
        """Return the data with these bounds, if they can hold the load. Collective."""
        try:
            feasible = self._balance(SlipBound(radius, np.zeros_like(radius)))
        except UnresistedMotion:
            return None
        return replace(self._given, radius=radius, feasible=feasible)

    def moved(self, outcome: Outcome, radius: Vector) -> Iterate:
        """Return an iterate with the forces of sites that slip at their new bounds.

        Where they had no bound, their slips give the directions.
        """
        friction, slips = self._friction, outcome.candidate.slips
        multipliers, before = outcome.iterate.multipliers, outcome.candidate.radius
        forces = friction.at_sites(multipliers)
        forces = balls.on_boundary(forces, radius, ~balls.inside(forces, before))
        starting = (before == 0.0) & slips.any(axis=1)
        forces = np.where(starting[:, None], balls.on_boundary(slips, radius, starting), forces)
        return Iterate(friction.with_sites(multipliers, forces), slips=slips)

    def error(self, candidate: Candidate, radius: Vector) -> float:
        """Return how far forces are from the law with these bounds, relative to the bounds.

        Where something slips that is the difference between force and bound, elsewhere the excess
        over the bound.
        """
        friction = self._friction
        force = np.linalg.norm(friction.at_sites(candidate.multipliers), axis=1)
        excess = force - radius
        slipping = ~candidate.recovered.sticking
        excess = friction.scale * np.where(slipping, np.abs(excess), np.maximum(excess, 0.0))
        bounds = friction.scale * radius
        error, bound, size = (self._dot(x, x) for x in (excess, bounds, friction.scale * force))
        largest = max(bound, size)
        return float(np.sqrt(error / largest)) if largest > 0.0 else 0.0

    def _dot(self, x: Vector, y: Vector) -> float:
        """Return the inner product of values at sites. Collective."""
        mine = self._friction.owned(self._layout.owned)
        return float(self._layout.comm.allreduce(float(x[mine] @ y[mine])))
