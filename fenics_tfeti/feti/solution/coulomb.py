"""Coulomb's law of friction by a fixed point on the slip bounds.

repeat
lambda   solution with the bounds r (Tresca), to a tolerance that follows the change of r
r        bound + coefficient * lambda_N
stop     when the forces fulfil the law with the bounds that they make themselves

Where several loose bodies hold each other the bounds follow the forces within a solution, by
projected gradients; the fixed point goes on from there.

The map contracts where the coefficient is small enough. Where it does not, the iterations end with
the ratio of their changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fenics_tfeti.errors import UnresistedMotion
from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.constraints.friction import SlipBound
from fenics_tfeti.feti.dual.iterate import Iterate, SolveStatus
from fenics_tfeti.feti.solution.outer import iterate_until_certified
from fenics_tfeti.feti.solution.setup import SolveContext
from fenics_tfeti.feti.solution.states import Outcome, SlipBoundStep
from fenics_tfeti.feti.tolerances import CERTIFIED, ZERO
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Vector

# largest tolerance of a solution, the first one's; that of others relative to the last change
_FIRST_RTOL, _INEXACT = 1e-2, 0.05
# the fixed point does not contract if so many steps reduce its changes by less than the ratio each
_STEPS, _RATIO = 15, 0.9
_MAX_STEPS = 100
# normal forces for the first bounds, relative to those of a feasible start at its limit
_AMPLE = 2.0
# the longest step of the fixed point; the shortest is its inverse
_LONGEST = 10.0
# part of the products that are spent before bounds follow the forces
_BEFORE = 0.2


def iterate_slip_bounds(
    context: SolveContext, start: Iterate | None, balance: Callable[[SlipBound], Vector]
) -> Outcome:
    """Solve the dual problem with slip bounds that depend on the normal forces.

    `balance` returns the feasible start for given bounds, or raises `UnresistedMotion`. Without
    `start` the first multipliers vanish. The outcome is that of the last candidate; its certificate
    has the error of the slip bounds.
    """
    comm = context.setup.constraints.layout.comm
    if not any_rank(comm, context.data.bound.slope):
        return iterate_until_certified(context, start)
    fixed_point = _FixedPoint.start(context, start, balance)
    while True:
        step = fixed_point.step()
        end = fixed_point.judge(step) or fixed_point.update(step)
        if end is not None and not fixed_point.begin_to_follow(end[0]):
            return step.result(*end)


@dataclass(frozen=True)
class _Step:
    """The solution with some bounds, the bounds that it makes, and its error against these."""

    outcome: Outcome
    radius: Vector
    change: float

    def result(self, status: SolveStatus, reason: str) -> Outcome:
        """Return the outcome with the error of the slip bounds in its certificate."""
        candidate = self.outcome.candidate
        certificate = replace(candidate.certificate, slip_bound_error=self.change, guaranteed=False)
        candidate = replace(candidate, certificate=certificate)
        return replace(self.outcome, candidate=candidate, status=status, reason=reason)


@dataclass
class _FixedPoint:
    """State of the fixed point on the slip bounds between two steps."""

    context: SolveContext  # with the bounds of the next step
    balance: Callable[[SlipBound], Vector]  # the feasible start for given bounds
    iterate: Iterate | None  # start of the next step
    rtol: float  # tolerance of the next step
    loosest: float = _FIRST_RTOL  # upper bound of the tolerances of later steps
    changes: list[float] = field(default_factory=list)  # errors of the steps so far
    residual: Vector | None = None  # (k,) change of the bounds that the last step asked for
    length: float = 1.0  # the part of it that was taken
    follows: bool = False  # whether the bounds follow the forces within a step
    may_follow: bool = False  # whether they may where steps do not converge

    @staticmethod
    def start(
        context: SolveContext, iterate: Iterate | None, balance: Callable[[SlipBound], Vector]
    ) -> _FixedPoint:
        """Return the first step, with bounds that can hold the load. Collective."""
        friction, comm = context.setup.constraints.friction, context.setup.constraints.layout.comm
        loose, curved = _are_loose(context), friction.curved
        follows = loose and not curved
        rtol = context.options.rtol if follows else max(context.options.rtol, _FIRST_RTOL)
        fixed_point = _FixedPoint(
            context, balance, iterate, rtol, follows=follows, may_follow=loose and curved
        )
        if iterate is not None and fixed_point._hold(fixed_point._bounds(iterate.multipliers)):
            # a looser solution may be farther away than the start, that of a short time step
            fixed_point.rtol = context.options.rtol
            return fixed_point
        feasible = context.data.feasible
        radius = fixed_point._bounds(feasible)
        limited = (radius > 0.0) & ~balls.inside(friction.at_sites(feasible), radius)
        if any_rank(comm, limited):
            # these bounds may hold the load at the limit, where the motion is not unique
            radius = fixed_point._bounds(_AMPLE * feasible)
        # without bounds contact shares the load with soft supports: a better first active set
        if any_rank(comm, radius) or not fixed_point._hold(radius):
            fixed_point.context = replace(context, data=replace(context.data, radius=radius))
        return fixed_point

    def step(self) -> _Step:
        """Solve with the bounds, and find those that the normal forces make."""
        context, products = self.context, self.context.monitor.history.products
        before = products.total
        limit = int((_BEFORE if self.may_follow else 1.0) * context.options.max_products)
        options = replace(context.options, rtol=self.rtol, max_products=limit)
        inner = replace(context, options=options)
        preliminary = bool(self.changes) and self.rtol > context.options.rtol
        outcome = iterate_until_certified(
            inner,
            self.iterate,
            self._bounds if self.follows else None,
            self._suffices if preliminary else None,
        )
        # another method has gone on from where projected gradients made no progress
        self.follows = self.follows and outcome.iterate.radius is not None
        data = replace(context.data, radius=outcome.candidate.radius)
        self.context = replace(context, data=data)
        candidate = outcome.candidate
        radius = self._bounds(candidate.multipliers)
        change = self._error(candidate.multipliers, candidate.recovered.face.sticking, radius)
        ratio = change / self.changes[-1] if self.changes and self.changes[-1] > 0.0 else None
        self.changes.append(change)
        context.monitor.tell(SlipBoundStep(products.total - before, change, ratio, self.rtol))
        return _Step(outcome, radius, change)

    def judge(self, step: _Step) -> tuple[SolveStatus, str] | None:
        """Return how the fixed point ends with a step; None if it goes on."""
        rtol, outcome = self.context.options.rtol, step.outcome
        if not outcome.converged and outcome.status is not SolveStatus.INEXACT:
            number = len(self.changes)
            return outcome.status, f"{outcome.reason}; in step {number} of the slip bounds"
        if max(step.change, self.rtol) <= rtol:
            return outcome.status, outcome.reason
        if interruption.agreed():
            return SolveStatus.INTERRUPTED, "interrupted"
        reason = _failure(self.changes)
        if reason:
            return SolveStatus.STALLED, reason
        if len(self.changes) == _MAX_STEPS:
            return SolveStatus.OUT_OF_STEPS, f"limit of {_MAX_STEPS} steps of Coulomb's law"
        return None

    def begin_to_follow(self, ended: SolveStatus) -> bool:
        """Let the bounds follow the forces after steps that have failed, if they may."""
        done = ended in (SolveStatus.SOLVED, SolveStatus.INTERRUPTED)
        if done or not self.may_follow:
            return False
        self.follows, self.may_follow = True, False
        self.iterate, self.rtol = None, self.context.options.rtol
        self.changes.clear()
        return True

    def update(self, step: _Step) -> tuple[SolveStatus, str] | None:
        """Take bounds on the way to those of a step; return the end where none hold the load.

        Collective.
        """
        data, scale = self.context.data, self.context.setup.constraints.friction.scale
        residual = scale * (step.radius - data.radius)
        self.length, self.residual = self._aitken_length(residual), residual
        part, halved = self.length, False
        while part > ZERO:
            bounds = np.maximum(data.radius + part * residual / scale, 0.0)
            # no parts of bounds where nothing presses any more: they would have large curvatures
            held = self._hold(np.where(step.radius > 0.0, bounds, 0.0))
            if held and (part == self.length or halved):
                break
            # bounds that hold the load at the limit have no unique motion: once more than needed
            part, halved = 0.5 * part, held
        else:
            reason = (
                "no slip bounds near those of the last step can hold the load: apply it in steps, "
                "or hold the bodies that slide by more than friction"
            )
            return SolveStatus.STALLED, reason
        self.iterate = self._moved(step.outcome)
        self.loosest = min(self.loosest, _INEXACT * step.change)
        self.rtol = max(self.context.options.rtol, self.loosest)
        return None

    def _aitken_length(self, residual: Vector) -> float:
        """Return the length of a step by Aitken's method (Irons, Tuck 1969). Collective."""
        if self.residual is None:
            return self.length
        turn = residual - self.residual
        length, turn2 = self.length, self._dot(turn, turn)
        if turn2 > 0.0:
            length *= -self._dot(self.residual, turn) / turn2
        # bounds that grow more and more: the sooner the better where all sticks in the end
        return min(max(length, 1.0 / _LONGEST), _LONGEST) if length > 0.0 else _LONGEST

    def _hold(self, radius: Vector) -> bool:
        """Take bounds for the next step if they can hold the load. Collective."""
        try:
            feasible = self.balance(SlipBound(radius, np.zeros_like(radius)))
        except UnresistedMotion:
            return False
        data = replace(self.context.data, radius=radius, feasible=feasible)
        self.context = replace(self.context, data=data)
        return True

    def _bounds(self, multipliers: Vector) -> Vector:
        """Return the bounds r that normal forces make. Collective."""
        constraints = self.context.setup.constraints
        pressing = constraints.friction.pressing(multipliers, constraints.layout)
        return self.context.data.bound.at(pressing)

    def _moved(self, outcome: Outcome) -> Iterate:
        """Return an iterate with the forces of sites that slip at their new bounds."""
        friction, slips = self.context.setup.constraints.friction, outcome.candidate.slips
        radius, before = self.context.data.radius, outcome.candidate.radius
        multipliers = outcome.iterate.multipliers
        forces = friction.at_sites(multipliers)
        forces = balls.on_boundary(forces, radius, ~balls.inside(forces, before))
        # without a bound before, slips give the directions
        starting = (before == 0.0) & slips.any(axis=1)
        forces = np.where(starting[:, None], balls.on_boundary(slips, radius, starting), forces)
        return Iterate(friction.with_sites(multipliers, forces), slips=slips)

    def _suffices(self, iterate: Iterate) -> bool:
        """Tell whether an iterate makes better bounds than those of the last step. Collective.

        No accurate solution is needed with bounds that are still far from its own.
        """
        assert iterate.on_face is not None
        radius, sticking = self._bounds(iterate.multipliers), iterate.on_face.face.sticking
        return self._error(iterate.multipliers, sticking, radius) <= _RATIO * self.changes[-1]

    def _error(self, multipliers: Vector, sticking: Mask, radius: Vector) -> float:
        """Return the excess of forces over bounds, the difference at slips, relative to bounds."""
        friction = self.context.setup.constraints.friction
        force = np.linalg.norm(friction.at_sites(multipliers), axis=1)
        excess = force - radius
        excess = friction.scale * np.where(sticking, np.maximum(excess, 0.0), np.abs(excess))
        limited = self.context.data.bound.limited
        bounds, forces = (friction.scale * limited(x) for x in (radius, force))
        error, bound, size = (self._dot(x, x) for x in (excess, bounds, forces))
        largest = max(bound, size)
        return float(np.sqrt(error / largest)) if largest > 0.0 else 0.0

    def _dot(self, x: Vector, y: Vector) -> float:
        """Return the inner product of values at sites. Collective."""
        constraints = self.context.setup.constraints
        owned = constraints.owned_sites
        return float(constraints.layout.comm.allreduce(float(x[owned] @ y[owned])))


def _are_loose(context: SolveContext) -> bool:
    """Tell whether several loose bodies hold each other: active sets are often mechanisms then.

    Where bounds are intervals they follow the forces from the start. Projections on discs, in the
    metric of rows that nearly depend on each other, take many steps: there the active set goes
    first. Steps along the gradient are too short for springs.
    """
    if context.data.springs is not None:
        return False
    coarse_space = context.setup.projector.coarse_space
    free = coarse_space.resistance_of_supports().free
    loose = np.unique(free.nonzero()[0] // coarse_space.bodies.modes)
    return context.options.method == "active_set" and loose.size > 1


def _failure(changes: Sequence[float]) -> str:
    """Return why the fixed point is given up; nothing if it goes on."""
    last = len(changes) - 1
    # changes that are rounding, as of a solution that is the last one, say nothing about the map
    if last < _STEPS or changes[last - _STEPS] <= CERTIFIED:
        return ""
    if changes[last] > _RATIO**_STEPS * changes[last - _STEPS]:
        ratio = (changes[last] / changes[last - _STEPS]) ** (1.0 / _STEPS)
        return (
            f"the slip bounds of Coulomb's law do not converge: their changes are reduced by a "
            f"factor of {ratio:.2f} a step only, and are {changes[last]:.1e} of the bounds. The "
            "coefficient of friction may be too large for a unique solution, or too small to hold "
            "the load"
        )
    return ""
