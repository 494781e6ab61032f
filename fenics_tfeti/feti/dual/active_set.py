"""Primal-dual active set method (semismooth Newton) for the dual problem (11.36), with friction.

Each step takes the active contact rows as equalities and drops the others, and solves that linear
problem by PCPG with the projector of these rows. The signs of forces and gaps give the next active
set. Rows with springs that may pull are never dropped: their branch follows the sign of the force.
The method alone may cycle; then another one goes on.

With friction sites stick, their tangential rows being equalities, or slip with a force of size r
in the direction of l - k g with a stiffness k, which turns in the linear problem (Newton's
method).

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.dual.dependent_rows import closable
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.iterate import ActiveSetStep, Iterate, Method, SolveStatus, Turn
from fenics_tfeti.feti.dual.loose_bodies import LooseBodies
from fenics_tfeti.feti.dual.pcpg import PCPGIterate, friction_step, pcpg, plastic_slip
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Vector

# forces below this part of the largest one are treated as zero
_NO_FORCE = 1e-14
# the method stagnates where the violation of signs was not reduced by this factor in so many
# consecutive faces
_FAILURES, _REDUCED = 8, 0.7


def primal_dual_active_set(problem: DualProblem, start: Iterate, turn: Turn) -> Iterate:
    """Run the active set method until its set does not change, or it cycles.

    Its status is AT_ROUNDING if the residual of the last iterate is rounding, STALLED if the set
    has occurred before or the share of the products is spent. An iterate on a face is continued.
    """
    method = _ActiveSet.start(problem, start, turn)
    while True:
        step = method.step()
        status = method.judge(step)
        if status is not None:
            if status is SolveStatus.STALLED and not turn.is_spent:
                sets = *method.cycle, *method.progress.sets
                start = start.remembering(Method.ACTIVE_SET, sets)
            return iterate_on_face(problem, start, step.iterate, status)
        method.update(step)


def iterate_on_face(
    problem: DualProblem, start: Iterate, on_face: PCPGIterate, status: SolveStatus
) -> Iterate:
    """Return the iterate with feasible multipliers that an iterate on a face makes."""
    none = np.zeros_like(on_face.multipliers)
    multipliers = problem.multiplier_set(none).project(on_face.multipliers.copy())
    return replace(
        start, multipliers=multipliers, method=Method.ACTIVE_SET, status=status, on_face=on_face
    )


@dataclass(frozen=True)
class _Step:
    """The solution on a face, and the signs that it has."""

    face: Face
    iterate: PCPGIterate  # solution on the face, to some accuracy
    gradient: Vector  # (m,): in the position of loose bodies in which signs are tested
    active: Mask  # (i,): rows that would be on the face by these signs
    sticking: Mask  # (k,): sites that would be on it
    forces: Vector  # (k, gdim - 1): friction forces that the slips ask for
    changed: int  # rows and sites that differ from those of the face


@dataclass
class _ActiveSet:
    """State of the active set method between two faces."""

    problem: DualProblem
    turn: Turn
    has_friction: bool  # whether some site has a bound
    face: Face  # the next one
    iterate: Vector | PCPGIterate  # start on the next face
    gradient: Vector  # (m,): gaps, and slips with the opposite sign, before it
    resumes: bool  # whether the next face is that of the iterate
    cycle: tuple[Mask, ...]  # sets of the last cycle
    repeated: bool = False  # whether the last face was solved, and once more for its slips
    progress: _Progress = field(default_factory=lambda: _Progress())
    # active sets of faces that were solved to the tolerance
    exact_sets: list[Mask] = field(default_factory=list)

    @staticmethod
    def start(problem: DualProblem, start: Iterate, turn: Turn) -> _ActiveSet:
        """Return the first face: that of an iterate, of multipliers, or of rigid bodies."""
        rows = problem.constraints.inequality
        cycle: tuple[Mask, ...] = start.memory.get(Method.ACTIVE_SET, ())
        none = np.zeros(rows.size, dtype=bool)
        has_friction = bool(_counts(problem, none, sites=problem.radius > 0.0)[-1])
        if start.on_face is not None:
            face = start.on_face.face
            return _ActiveSet(
                problem, turn, has_friction, face, start.on_face, problem.c, True, cycle
            )
        multipliers = start.multipliers
        face = problem.face_of(multipliers, start.active, start.slips)
        # contact alone balances no load that friction holds
        if not has_friction and not _counts(problem, face.active)[0]:
            pressing = problem.feasible[rows]
            face = face.with_rows(pressing > 0.0, face.sticking)
            multipliers = multipliers.copy()
            multipliers[rows] += pressing
        return _ActiveSet(problem, turn, has_friction, face, multipliers, problem.c, False, cycle)

    def step(self) -> _Step:
        """Solve on the face, and find the signs of forces and gaps."""
        problem, turn = self.problem, self.turn
        rows = problem.constraints.inequality
        operators = close_first_gaps(problem, self.face, self.gradient)
        iterate = pcpg(
            problem,
            operators,
            self.iterate,
            tolerance=turn.tolerance,
            sign_factor=self.progress.sign_factor,
            max_products=turn.max_products,
            products=turn.products,
            resume=self.resumes,
        )
        face = operators.face
        gradient = _without_tensile_rows(problem, face, iterate)
        active = _pressing(problem, iterate.multipliers[rows], gradient[rows])
        forces = friction_step(problem, face, iterate.multipliers, gradient)
        sticking = balls.inside(forces, problem.radius)
        changed, size, moved = _counts(
            problem, active != face.active, face.active, sites=sticking != face.sticking
        )
        changed += moved
        turn.monitor(ActiveSetStep(turn.products.total, iterate.residual, size, changed))
        return _Step(face, iterate, gradient, active, sticking, forces, changed)

    def judge(self, step: _Step) -> SolveStatus | None:
        """Return how the method ends with a step; None if it goes on."""
        problem, iterate, tolerance = self.problem, step.iterate, self.turn.tolerance
        # the violation of signs in units of energy: F ~ ||PFP|| at worst
        negligible = tolerance * np.sqrt(problem.norm)
        solved = iterate.energy <= tolerance and iterate.violation <= negligible
        # slips beside their forces: one more step of Newton's method
        self.repeated = (
            solved
            and self.has_friction
            and not self.repeated
            and unused_friction(problem, step.face, iterate) > tolerance
        )
        if (
            solved
            and not self.repeated
            and closable(problem, step.face, iterate.multipliers) is None
        ):
            return SolveStatus.SOLVED
        self.progress.update(iterate.violation, step.face.active)
        if iterate.at_limit:
            return SolveStatus.AT_ROUNDING
        if self._cycles(step) or self.progress.stagnates or self.turn.is_spent:
            return SolveStatus.STALLED
        return SolveStatus.INTERRUPTED if interruption.agreed() else None

    def _cycles(self, step: _Step) -> bool:
        """Tell whether the next set has occurred before; with friction sets may come back."""
        if self.has_friction:
            return False
        exact = step.iterate.energy <= self.turn.tolerance
        sets = [*self.cycle, *self.exact_sets] if exact else self.cycle
        return bool(sets) and 0 in _counts(self.problem, *(step.active != s for s in sets))

    def update(self, step: _Step) -> None:
        """Take the signs of a step as the next face."""
        problem, face, iterate, gradient = self.problem, step.face, step.iterate, step.gradient
        exact = iterate.energy <= self.turn.tolerance
        if exact:
            self.exact_sets.append(face.active)
        forces = problem.constraints.friction.spread(step.forces, gradient.size)
        following = _face(problem, step.active, step.sticking, forces, gradient)
        closed = closable(problem, following, iterate.multipliers)
        if closed is not None:
            following = _face(problem, closed.active, closed.sticking, closed.forces, gradient)
        # a face that is solved exactly makes no more progress: its directions have to change
        rotates = self.has_friction and (exact or _turned(problem, face, iterate, step.forces))
        self.resumes = step.changed == 0 and closed is None and not rotates
        self.face = face.with_rows(step.active, face.sticking) if self.resumes else following
        self.iterate, self.gradient = iterate, gradient


@dataclass
class _Progress:
    """The decrease of the violation of signs from face to face.

    Signs may have been those of inaccurate solutions: where the violation does not decrease, the
    sign factor is halved.
    """

    sign_factor: float = 1.0  # tolerance of the residual on a face, relative to the violation
    smallest: float = np.inf
    best: float = np.inf  # the smallest but for small decreases
    sets: list[Mask] = field(default_factory=list)  # of the faces from the best one on

    def update(self, violation: float, active: Mask) -> None:
        """Compare with the smallest violation so far."""
        if violation >= self.smallest:
            self.sign_factor *= 0.5
        self.smallest = min(violation, self.smallest)
        if violation < _REDUCED * self.best:
            self.best = violation
            self.sets.clear()
        self.sets.append(active)

    @property
    def stagnates(self) -> bool:
        """Tell whether the violation has not decreased for too many faces."""
        return len(self.sets) - 1 > _FAILURES


def _without_tensile_rows(problem: DualProblem, face: Face, iterate: PCPGIterate) -> Vector:
    """Return the gradient after the motion with the least penetration of what pushes do not hold.

    Rows that pull will leave the set. The position of a body that only they hold is no more known
    than that of a loose one.
    """
    constraints, active = problem.constraints, face.active
    forces = iterate.multipliers[constraints.inequality]
    largest = largest_of_ranks(constraints.layout.comm, forces)
    compressive = active & (forces > _NO_FORCE * largest)
    everywhere = np.ones(constraints.friction.size, dtype=bool)
    leaving = active & ~compressive
    if problem.springs is not None:
        leaving &= ~problem.springs.pulling
    tensile, sites = _counts(problem, leaving, sites=everywhere)
    if sites or not tensile:
        return iterate.gradient
    face = Face.of(constraints, compressive, springs=problem.springs)
    free = problem.coarse_space.resistance(face).free
    loose = LooseBodies.of(problem.coarse_space, face, free)
    return iterate.gradient if loose is None else loose.at_least_penetration(iterate.gradient)


def _pressing(problem: DualProblem, force: Vector, gap: Vector) -> Mask:
    """Return the contact rows (i,) that press by their multipliers and gaps (i,)."""
    active: Mask = force > gap / problem.norm
    springs = problem.springs
    return active if springs is None else np.where(springs.pulling, force > 0.0, active)


def _counts(problem: DualProblem, *masks: Mask, sites: Mask | None = None) -> list[int]:
    """Count masks over the inequality rows, and one over sites, of all ranks; one reduction."""
    owned = problem.constraints.owned_inequalities
    part = [float(np.count_nonzero(mask[:owned])) for mask in masks]
    if sites is not None:
        part.append(float(np.count_nonzero(sites & problem.constraints.owned_sites)))
    return [int(n) for n in problem.space.sums(*part)]


def unused_friction(problem: DualProblem, face: Face, iterate: PCPGIterate) -> float:
    """Return the square root of the sum of 2 (r |s| - l_T's) over the sites that slip. Collective.

    It is part of the error of the displacement; zero where slips s are along the forces.
    """
    friction = problem.constraints.friction
    along = balls.directions(friction.at_sites(iterate.multipliers))
    unused = problem.radius * balls.misalignment(-friction.at_sites(iterate.gradient), along)
    counted = ~face.sticking & problem.constraints.owned_sites
    return float(np.sqrt(2.0 * max(problem.space.sums(float(unused @ counted))[0], 0.0)))


def _turned(problem: DualProblem, face: Face, iterate: PCPGIterate, forces: Vector) -> bool:
    """Tell whether the forces of slips change by more than the residual on the face. Collective."""
    friction = problem.constraints.friction
    change = np.zeros_like(iterate.gradient)
    slipping = friction.present & ~face.sticking[:, None]
    change[friction.rows[slipping]] = (forces - friction.at_sites(face.forces))[slipping]
    return problem.norm * problem.space.norm(change) > iterate.residual


def close_first_gaps(problem: DualProblem, face: Face, gradient: Vector) -> FaceOperators:
    """Return the operators of a face, with rows added that bodies close when the load moves them.

    Where the load does work on motions that the rows leave free, the bodies move until the first
    gaps close, or the first slips are taken back; these rows join the face, and so on until the
    load is balanced. The gradient (m,) is the gap on contact rows, scaled as the row, negative gaps
    counting as closed, and minus the slip on tangential rows.
    """
    coarse_space, friction = problem.coarse_space, problem.constraints.friction
    gap = np.maximum(gradient[problem.constraints.inequality], 0.0)
    along = face.directions
    slip = np.sum(-plastic_slip(problem, face.forces, gradient) * along, axis=1)
    slip = np.maximum(slip, 0.0)
    active, sticking = face.active, face.sticking
    # where slip / bound exceeds 1e9 compliances the force keeps its direction on a face: rounding
    # would exceed what it turns by, and in the next face ZERO of the angle is left
    stiff = ZERO * problem.unit * face.curvature > 1.0
    while True:
        face = face.with_rows(active, sticking).with_turning_forces(but=stiff)
        projector = Projector.build(coarse_space, face)
        work = projector.unresisted(_load(problem, face), problem.e_size)
        if not work.any():
            return FaceOperators.build(problem, projector)
        speed = coarse_space.contact.T @ work
        on_face = face.rows[problem.constraints.inequality]
        closing = ~on_face & (speed > ZERO * np.linalg.norm(work))
        step = np.divide(gap, speed, out=np.full(gap.size, np.inf), where=closing)
        back = -np.sum(friction.at_sites(coarse_space.friction.T @ work) * along, axis=1)
        returning = ~sticking & (back > ZERO * np.linalg.norm(work))
        step_back = np.divide(slip, back, out=np.full(slip.size, np.inf), where=returning)
        nearest = min(step.min(initial=np.inf), step_back.min(initial=np.inf))
        first = problem.space.dots_and_min(value=float(nearest))[0]
        if not np.isfinite(first):
            return FaceOperators.build(problem, projector)
        # rows that close at once, up to rounding, join together
        active = active | (step <= first * (1.0 + ZERO))
        sticking = sticking | (step_back <= first * (1.0 + ZERO))
        gap = np.where(active, 0.0, np.maximum(gap - first * speed, 0.0))
        slip = np.maximum(slip - first * back, 0.0)


def _face(
    problem: DualProblem, active: Mask, sticking: Mask, forces: Vector, gradient: Vector
) -> Face:
    """Return a face with the curvature that the slips of a gradient have along the forces."""
    friction = problem.constraints.friction
    slips = -friction.at_sites(gradient)
    curvature = balls.curvature(friction.at_sites(forces), slips, problem.radius)
    return Face.of(problem.constraints, active, sticking, forces, curvature, problem.springs)


def _load(problem: DualProblem, face: Face) -> Vector:
    """Return e without what the forces of slips carry."""
    fixed = face.fixed
    carried = problem.space.sums(float(np.count_nonzero(fixed)))[0]
    return problem.e - problem.coarse_space.restrict(fixed) if carried else problem.e
