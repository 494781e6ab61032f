"""Proximal point method with Newton steps for the dual problem (11.36) with friction.

For multipliers l_k that are feasible on the rows with bounds, the proximal problem

    minimise 1/2 l'Fl - d'l + |l - l_k|^2 / (2 rho)  subject to  Gl = e and the bounds,

is the dual of an unconstrained one in the displacements: its cost is that of the bodies and a
function of the jumps v of the rows with bounds, with the derivative P(l_k + rho v), P the
projection on the bounds, with springs divided by 1 + rho C. Newton's method takes the linear part
of P, which is a problem on a face that PCPG solves, also where rows of the face depend on each
other. The cost is convex with a continuous derivative, so that with a line search Newton's method
converges for any bounds. Along the way from one state (l, v) to the next both are linear, and the
slope of the cost is v'(P(l_k + rho v) - l): the line search takes no product with F.

The solution of one proximal problem is the next l_k, and rho grows: the method of multipliers for
the displacements.

After Rockafellar, Math. Oper. Res. 1 (1976) 97-116, and Sun, Sun, Qi, SIAM J. Optim. 16 (2006)
964-1006.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.constraints.face import Face, Proximal
from fenics_tfeti.feti.dual.active_set import (
    close_first_gaps,
    iterate_on_face,
    unused_friction,
)
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.iterate import ActiveSetStep, Iterate, Method, SolveStatus, Turn
from fenics_tfeti.feti.dual.pcpg import PCPGIterate, first_iterate, iterate_on, pcpg
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import Products
from fenics_tfeti.typing import Vector

# rho in units of the stiffness that a weight of 1 stands for: the first, growth, the largest
_FIRST, _GROWTH, _LARGEST = 10.0, 10.0, 1e5
# the centre is updated once the error of Newton's method is below this part of the distance moved
_INEXACT = 0.5
# residual and energy of a Newton step, relative to the error before it
_RESIDUAL, _ENERGY = 0.1, 1e-3
# slope that ends the line search, relative to the first; limit on its halvings
_SLOPE, _HALVINGS = 0.01, 40
# steps that may fail to reduce the error by half before rounding is the reason
_PATIENCE = 40


def proximal_newton(problem: DualProblem, start: Iterate, turn: Turn) -> Iterate:
    """Solve the next proximal problem: CENTRED, or SOLVED where that solves (11.36) as well.

    It goes on from the last one, or from an iterate on a face, or multipliers. A solution is a
    start for the active set method, whose solution has forces that vanish exactly.
    """
    bounds = _Bounds(problem)
    state = _first_state(problem, start, turn)
    term = state.face.proximal
    if term is None:
        term = Proximal(bounds.project(state.multipliers), _FIRST * problem.unit)
    state, status = _solve_proximal(problem, bounds, term, state, turn)
    multipliers = bounds.projected(term, state)
    iterate = _iterate(problem, start, state, multipliers, status)
    if status is not SolveStatus.CENTRED:
        return iterate
    stiffness = min(_GROWTH * term.stiffness, _LARGEST * problem.unit)
    term = Proximal(bounds.chosen(multipliers), stiffness)
    following = replace(state, face=replace(state.face, proximal=term))
    # multipliers P(l_k + rho v) are those of the residual where they solve (11.36) only
    iterate = iterate.at_multipliers(-problem.constraints.friction.at_sites(state.gradient))
    return iterate.remembering(Method.NEWTON, following)


def _solve_proximal(
    problem: DualProblem, bounds: _Bounds, term: Proximal, state: PCPGIterate, turn: Turn
) -> tuple[PCPGIterate, SolveStatus]:
    """Solve a proximal problem by Newton's method: SOLVED if that solves (11.36) as well."""
    best, failures = np.inf, 0
    while True:
        # a step that fails may have been too inaccurate
        error = bounds.error(term, state) * 0.5**failures
        linear_part = bounds.linear_part(term, state)
        operators = close_first_gaps(problem, linear_part, state.gradient)
        following = pcpg(
            problem,
            operators,
            state,
            tolerance=_ENERGY * error / np.sqrt(term.stiffness),
            sign_factor=0.0,
            max_products=turn.max_products,
            products=turn.products,
            accurate=_RESIDUAL * error / term.stiffness,
        )
        state = _on_the_way(problem, operators, bounds, term, state, following, turn.products)
        projected, error = bounds.projected(term, state), bounds.error(term, state)
        following_part = bounds.linear_part(term, state)
        turn.monitor(_step(problem, linear_part, following_part, state, turn.products))
        unused = unused_friction(problem, operators.face, replace(state, multipliers=projected))
        residuals = (state.energy, error / np.sqrt(term.stiffness), unused)
        solved = all(residual <= turn.tolerance for residual in residuals)
        best, failures = (error, 0) if error <= 0.5 * best else (best, failures + 1)
        state = replace(state, face=replace(operators.face, proximal=term))
        if solved:
            return state, SolveStatus.SOLVED
        if turn.is_spent or failures > _PATIENCE or interruption.agreed():
            return state, SolveStatus.STALLED
        if error <= _INEXACT * bounds.norm(projected - term.centre):
            return state, SolveStatus.CENTRED


def _iterate(
    problem: DualProblem, start: Iterate, state: PCPGIterate, projected: Vector, status: SolveStatus
) -> Iterate:
    """Return the iterate with multipliers P(l_k + rho v), on the face without the proximal term."""
    iterate = iterate_on_face(problem, start, replace(state, multipliers=projected), status)
    on_face = replace(state, face=replace(state.face, proximal=None))
    iterate = replace(iterate, method=Method.NEWTON, on_face=on_face)
    return iterate.remembering(Method.NEWTON, state)


@dataclass(frozen=True)
class _Bounds:
    """The rows with bounds: contact and tangential ones."""

    problem: DualProblem

    def chosen(self, x: Vector) -> Vector:
        """Return x on these rows, zero on the others."""
        return np.where(self.problem.constraints.equality, 0.0, x)

    def project(self, x: Vector) -> Vector:
        """Return the projection of x on the bounds; zero on equality rows."""
        feasible = self.problem.multiplier_set(np.zeros_like(x))
        return self.chosen(feasible.project(x.copy()))

    def limited(self, x: Vector, stiffness: float) -> Vector:
        """Return P(x) of the term with a stiffness."""
        return self.project(self.softened(x, stiffness))

    def softened(self, x: Vector, stiffness: float) -> Vector:
        """Return x divided by 1 + rho C, the C of springs."""
        constraints, springs = self.problem.constraints, self.problem.springs
        if springs is None:
            return x
        rows, compliance = constraints.inequality, np.zeros_like(x)
        compliance[rows] = springs.of(x[rows])
        compliance += constraints.friction.spread(springs.sticking, x.size)
        return x / (1.0 + stiffness * compliance)

    def norm(self, x: Vector) -> float:
        """Return the norm on these rows. Collective."""
        x = self.chosen(x)
        return float(np.sqrt(self.problem.space.dots((x, x))[0]))

    def forces(self, term: Proximal, state: PCPGIterate) -> Vector:
        """Return P(l_k + rho v)."""
        return self.limited(term.forces(state.gradient), term.stiffness)

    def projected(self, term: Proximal, state: PCPGIterate) -> Vector:
        """Return the multipliers with P(l_k + rho v) on these rows."""
        equality = self.problem.constraints.equality
        return np.where(equality, state.multipliers, self.forces(term, state))

    def error(self, term: Proximal, state: PCPGIterate) -> float:
        """Return the norm of P(l_k + rho v) - l, the residual of the proximal problem [N]."""
        return self.norm(self.forces(term, state) - state.multipliers)

    def linear_part(self, term: Proximal, state: PCPGIterate) -> Face:
        """Return the face that is the linear part of P at l_k + rho v."""
        constraints, radius = self.problem.constraints, self.problem.radius
        friction, unbounded = constraints.friction, term.forces(state.gradient)
        length = np.linalg.norm(friction.at_sites(unbounded), axis=1)
        softened = friction.at_sites(self.softened(unbounded, term.stiffness))
        slipping = np.linalg.norm(softened, axis=1) >= radius
        curvature = np.zeros_like(radius)
        turning = slipping & (radius > 0.0)
        np.divide(length, radius * term.stiffness, out=curvature, where=turning)
        active = unbounded[constraints.inequality] > 0.0
        forces, springs = self.limited(unbounded, term.stiffness), self.problem.springs
        face = Face.of(constraints, active, ~slipping, forces, curvature, springs)
        return replace(face, proximal=term)

    def slope(self, term: Proximal, state: PCPGIterate, following: PCPGIterate, t: float) -> float:
        """Return the slope of the cost on the way from one state to another. Collective."""
        change = state.gradient - following.gradient
        l = state.multipliers + t * (following.multipliers - state.multipliers)
        forces = self.limited(term.forces(state.gradient - t * change), term.stiffness)
        return float(self.problem.space.dots((self.chosen(change), forces - l))[0])


def _first_state(problem: DualProblem, start: Iterate, turn: Turn) -> PCPGIterate:
    """Return an iterate with its gradient on all rows: that of the start, or one on its face."""
    known: PCPGIterate | None = start.memory.get(Method.NEWTON) or start.on_face
    if known is not None:
        return known
    face = problem.face_of(start.multipliers, start.active, start.slips)
    return pcpg(
        problem,
        close_first_gaps(problem, face, problem.c),
        start.multipliers,
        tolerance=0.0,
        sign_factor=1.0,
        max_products=turn.max_products,
        products=turn.products,
    )


def _on_the_way(
    problem: DualProblem,
    operators: FaceOperators,
    bounds: _Bounds,
    term: Proximal,
    state: PCPGIterate,
    following: PCPGIterate,
    products: Products,
) -> PCPGIterate:
    """Return the state of least cost on the way to the following one, or that. Collective."""
    # forces that turn have no residual where the slip is along them
    face, none = operators.face, np.zeros_like(operators.face.curvature)
    plain = operators.with_terms(replace(face, proximal=None, curvature=none))
    t = _root(lambda t: bounds.slope(term, state, following, t))
    if t == 0.0:
        # no way down: rounding of larger multipliers before has added up in the gradient
        return first_iterate(problem, plain, state.multipliers, products)
    l = state.multipliers + t * (following.multipliers - state.multipliers)
    gradient = state.gradient + t * (following.gradient - state.gradient)
    return iterate_on(problem, plain, l, gradient, following.step_lengths, products)


def _root(slope: Callable[[float], float]) -> float:
    """Return where an increasing function is nearest to zero in [0, 1]; 1 up to its accuracy."""
    first = slope(0.0)
    if slope(1.0) <= _SLOPE * abs(first):
        return 1.0
    if first >= 0.0:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        t = 0.5 * (low + high)
        value = slope(t)
        if abs(value) <= _SLOPE * abs(first):
            return t
        low, high = (low, t) if value > 0.0 else (t, high)
    return 0.5 * (low + high)


def _step(
    problem: DualProblem,
    before: Face,
    after: Face,
    state: PCPGIterate,
    products: Products,
) -> ActiveSetStep:
    """Return what the monitor is told of a step between two sets. Collective."""
    constraints = problem.constraints
    owned, owned_sites = constraints.owned_inequalities, constraints.owned_sites
    changed = np.count_nonzero((after.active != before.active)[:owned])
    changed += np.count_nonzero((after.sticking != before.sticking)[owned_sites])
    active = np.count_nonzero(after.active[:owned])
    active, changed = (int(n) for n in problem.space.sums(float(active), float(changed)))
    return ActiveSetStep(products.total, state.residual, active, changed)
