"""Accelerated projected gradients for the dual problem (11.36) with friction and loose bodies.

repeat
l    the point with Gl = e and the bounds that is nearest to y - tau (Fy - d): `ExactProjection`
r    half of the way to the bounds that the normal forces of l make
y    l and its momentum, restarted where the cost rises

No active set is solved for, so none can be a mechanism: bodies that only contact and friction hold
are balanced in each step. With Coulomb's law the bounds r follow the forces at once. Where bounds
cannot hold the load, none of them is reduced. The step tau is that of a few Lanczos steps, and is
shortened where the curvature of a step is larger. Rows that glue bodies which are cut have the
preconditioner of their face in place of the identity, as large as ||PFP||.

After Beck, Teboulle, SIAM J. Imaging Sci. 2 (2009) 183-202, and O'Donoghue, Candes, Found. Comput.
Math. 15 (2015) 715-732.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.exact_projection import ExactProjection, GramMetric
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.iterate import (
    ActiveSetStep,
    Iterate,
    Method,
    SolveStatus,
    Turn,
)
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Mask, Vector

# part of the way to the bounds that the forces make. At 1 they cycle with a coefficient of 0.6
_RELAXED = 0.5
# curvature relative to 1 / tau that is too large, and the excess with which tau is shortened
_TOO_LARGE, _EXCESS = 1.001, 1.1
# products by which the size of the preconditioner of glued rows is found
_POWER_STEPS = 3
# steps after which the monitor is told
_TOLD = 10


def projected_gradients(
    problem: DualProblem,
    start: Iterate,
    turn: Turn,
    bounds: Callable[[Vector], Vector] | None = None,
) -> Iterate:
    """Run projected gradients until the residual and the change of the bounds are small.

    `bounds` returns the slip bounds (k,) that multipliers (m,) make; without it they are those of
    the problem. The iterate has the bounds that it was found with. It is STALLED where the bounds
    cannot hold the load, or the share of the products is spent.
    """
    method = _Method(problem, turn, bounds, _projection(problem, start, turn))
    state, status = method.first(start), None
    while status is None:
        state, status = method.step(state)
    return replace(
        start.remembering(Method.GRADIENTS, state),
        multipliers=state.l,
        method=Method.GRADIENTS,
        status=status,
        on_face=None,
        radius=state.radius,
    )


@dataclass(frozen=True)
class _State:
    """State of projected gradients between two steps; points have their products with F."""

    l: Vector  # (m,)
    Fl: Vector
    y: Vector  # l and its momentum
    Fy: Vector
    theta: float  # of the momentum
    curvature: float  # 1 / tau [m/N]
    radius: Vector  # (k,): r
    motion: Vector  # of the last projection
    project: ExactProjection


class _Method:
    """The steps of the method on one problem."""

    def __init__(
        self,
        problem: DualProblem,
        turn: Turn,
        bounds: Callable[[Vector], Vector] | None,
        project: ExactProjection,
    ) -> None:
        self.problem, self.turn, self.bounds, self.project = problem, turn, bounds, project
        self.metric, self.precondition = project.metric, project.preconditioner
        self.glued = problem.constraints.equality
        self.steps, self.told = 0, self._set_of(problem.feasible, problem.radius)

    def first(self, start: Iterate) -> _State:
        """Return the last state, or the feasible multipliers nearest to those of a start."""
        known: _State | None = start.memory.get(Method.GRADIENTS)
        if known is not None:
            self.told = self._set_of(known.l, known.radius)
            return known
        problem = self.problem
        radius = problem.radius if start.radius is None else start.radius
        if problem.space.norm(start.multipliers) > 0.0:
            b = self.metric(start.multipliers)
        else:
            # of surfaces a step from no forces, after which none press across open gaps
            b = np.where(self.glued, problem.feasible, problem.d / problem.norm)
        l = self.project(b, radius)
        Fl = self._product(l)
        project = self.project
        return _State(l, Fl, l, Fl, 1.0, problem.norm, radius, project.motion, project)

    def step(self, state: _State) -> tuple[_State, SolveStatus | None]:
        """Take a step, and tell how the method ends with it. Collective."""
        problem, turn = self.problem, self.turn
        found = self._projected(state)
        if found is None or interruption.agreed():
            return state, SolveStatus.STALLED
        l, radius, gradient = found
        Fl = self._product(l)
        way, change = l - state.y, l - state.l
        Hway = self.metric(way)
        if self.precondition is not None:
            Hway = np.where(self.glued, self.project.pull() - gradient, Hway)
        size2, curvature, turned, energy2 = problem.space.dots(
            (way, Hway), (way, Fl - state.Fy), (Hway, change), (l, Fl)
        )
        residual = float(np.sqrt(max(state.curvature * size2, 0.0)))
        steepest = state.curvature
        if curvature > _TOO_LARGE * steepest * size2:
            steepest = _EXCESS * curvature / size2
        if turned < 0.0:
            theta, y, Fy = 1.0, l, Fl
        else:
            theta = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * state.theta**2))
            momentum = (state.theta - 1.0) / theta
            y, Fy = l + momentum * change, Fl + momentum * (Fl - state.Fl)
        of_forces = radius if self.bounds is None else self.bounds(l)
        error = self._bounds_error(of_forces, radius)
        accurate = residual <= turn.tolerance and error * np.sqrt(energy2) <= turn.tolerance
        following = radius + _RELAXED * (of_forces - radius)
        # no parts of bounds where nothing presses any more
        following[of_forces == 0.0] = 0.0
        following = radius if accurate else following
        project = self.project
        state = _State(l, Fl, y, Fy, theta, steepest, following, project.motion, project)
        self.steps += 1
        if accurate or self.steps % _TOLD == 0:
            self._tell(l, radius, residual)
        if accurate:
            return state, SolveStatus.SOLVED
        return state, SolveStatus.STALLED if turn.is_spent else None

    def _projected(self, state: _State) -> tuple[Vector, Vector, Vector] | None:
        """Return the next multipliers, bounds with which they exist, and the gradient. Collective.

        The gradient (m,) is times the step.
        """
        gradient = (state.Fy - self.problem.d) / state.curvature
        b = self.metric(state.y)
        b = b - (gradient if self.precondition is None else self.precondition(gradient))
        force = np.linalg.norm(self.problem.constraints.friction.at_sites(state.l), axis=1)
        # the last multipliers are feasible with the bounds that were not reduced below their forces
        for radius in (state.radius, np.maximum(state.radius, force)):
            self.project.motion = state.motion
            l = self.project(b, radius)
            if self.project.balanced:
                return l, radius, gradient
        return None

    def _product(self, x: Vector) -> Vector:
        """Return Fx, counted. Collective."""
        self.turn.products.cg += 1
        return self.problem.constraints.layout.sum(self.problem.F(x))

    def _bounds_error(self, of_forces: Vector, radius: Vector) -> float:
        """Return the difference of bounds relative to those that the forces make. Collective."""
        constraints = self.problem.constraints
        owned, scale = constraints.owned_sites, constraints.friction.scale
        change, size = (scale * x for x in (of_forces - radius, of_forces))
        squares = self.problem.space.sums(*(float(x[owned] @ x[owned]) for x in (change, size)))
        return float(np.sqrt(squares[0] / (squares[1] or 1.0)))

    def _set_of(self, l: Vector, radius: Vector) -> tuple[Mask, Mask]:
        """Return which contact rows press and which sites stick."""
        constraints = self.problem.constraints
        force = np.linalg.norm(constraints.friction.at_sites(l), axis=1)
        return l[constraints.inequality] > 0.0, force < radius

    def _tell(self, l: Vector, radius: Vector, residual: float) -> None:
        """Tell the monitor of the rows and sites that have changed. Collective."""
        constraints, before = self.problem.constraints, self.told
        self.told = self._set_of(l, radius)
        owned = constraints.owned_inequalities
        changed = np.count_nonzero((self.told[0] != before[0])[:owned])
        changed += np.count_nonzero((self.told[1] != before[1])[constraints.owned_sites])
        active = np.count_nonzero(self.told[0][:owned])
        active, changed = (int(n) for n in self.problem.space.sums(float(active), float(changed)))
        # in metres, as that of a face
        length = residual * float(np.sqrt(self.problem.norm))
        self.turn.monitor(ActiveSetStep(self.turn.products.total, length, active, changed))


def _projection(problem: DualProblem, start: Iterate, turn: Turn) -> ExactProjection:
    """Return the projection of the last turn, or one for the problem. Collective."""
    known: _State | None = start.memory.get(Method.GRADIENTS)
    if known is not None:
        return known.project
    metric = GramMetric.build(problem.constraints)
    return ExactProjection(problem.coarse_space, problem.e, metric, _of_glued_rows(problem, turn))


def _of_glued_rows(problem: DualProblem, turn: Turn) -> Callable[[Vector], Vector] | None:
    """Return x -> Mx on glued rows and x on others, M the preconditioner of their face. Collective.

    M is as large as makes the largest eigenvalue of MPFP there about ||PFP||. None if there are no
    such rows, or is no preconditioner.
    """
    layout, glued = problem.constraints.layout, problem.constraints.equality
    if problem.preconditioner is None or not any_rank(layout.comm, glued):
        return None
    on_face = problem.preconditioner.on(Face.supports(problem.constraints))

    def apply(x: Vector) -> Vector:
        turn.products.preconditioner += 1
        return np.where(glued, layout.sum(on_face(np.where(glued, x, 0.0))), 0.0)

    x, largest = apply(seeded_vector(layout.numbers)), 0.0
    for _ in range(_POWER_STEPS):
        size = problem.space.norm(x)
        if not size:
            return None
        x = apply(problem.projector.P(layout.sum(problem.F(problem.projector.P(x / size)))))
        turn.products.cg += 1
        largest = problem.space.norm(x)
    if not largest:
        return None
    scale = problem.norm / largest
    return lambda x: np.where(glued, scale * apply(x), x)
