"""Primal-dual active set method (semismooth Newton) for the dual problem (11.36), with friction.

Each step takes the active contact rows as equalities and drops the others, and solves that linear
problem by PCPG with the projector of these rows. The signs of forces and gaps give the next active
set. The method alone may cycle: then one row changes at a time, the last one with a wrong sign,
until fewer signs are wrong than before. For definite problems that ends (Murty's rule); where it
takes too long, SMALBE-M continues from the last iterate.

With friction sites stick, their tangential rows being equalities, or slip with a force of size r
in the direction of l - k g with a stiffness k, which turns in the linear problem (Newton's
method). Where the directions do not come to rest, too, SMALBE-M continues.

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888, and Judice, Pires, Comput.
Oper. Res. 21 (1994) 587-596.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.dependent_rows import closable
from fenics_tfeti.feti.dual.loose_bodies import LooseBodies
from fenics_tfeti.feti.dual.pcpg import Face, PCPGIterate, Signs, friction_step, pcpg
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.tolerances import NO_WORK
from fenics_tfeti.qp import Products
from fenics_tfeti.typing import Mask, Vector

# limit on changes of one row
_SINGLE_STEPS = 100
# force, relative to the largest one, that is rounding
_NO_FORCE = 1e-14


@dataclass(frozen=True)
class ActiveSetStep:
    """One face of the primal-dual active set method.

    Attributes
    ----------
    products : int
        Products so far.
    residual : float
        Norm of the projected residual on the face [m].
    active : int
        Active contact rows of the face.
    changed : int
        Rows that enter or leave the set after it, and sites of friction that stick or slip
        after it.
    """

    products: int
    residual: float
    active: int
    changed: int


@dataclass(frozen=True)
class ActiveSetResult:
    """The last iterate of the active set method.

    Attributes
    ----------
    multipliers : (m,) array
        Feasible on contact and tangential rows, and G l = e except for what cutting forces there
        changes.
    coarse_gradient : (m,) array
        Q(Fl - d) + G'a with the rigid motions a: the equalities' part of the gradient.
    solved : bool
        Whether the energy of the residual and the signs are within the tolerance; if not, the set
        has occurred before, a limit was met, or the residual is rounding.
    iterate : PCPGIterate
        The last iterate on the last face, to continue to a smaller tolerance.
    """

    multipliers: Vector
    coarse_gradient: Vector
    solved: bool
    iterate: PCPGIterate


def primal_dual_active_set(
    problem: DualProblem,
    start: Vector | PCPGIterate,
    signs: Signs,
    *,
    tolerance: float,
    max_products: int,
    products: Products,
    monitor: Callable[[ActiveSetStep], None],
) -> ActiveSetResult:
    """Run the active set method until its set does not change, or it cycles.

    Parameters
    ----------
    problem : DualProblem
        The dual problem (11.36).
    start : (m,) array or PCPGIterate
        First multipliers, or the last iterate of an earlier run to a larger tolerance.
    signs : Signs
        First active set, and what sticks; of an earlier run, its last ones.
    tolerance : float
        Tolerance of the energy of the residual [sqrt(J)].
    max_products : int
        Limit on `products`.
    products : Products
        Counter to add to.
    monitor : callable
        Called with every `ActiveSetStep`.

    Returns
    -------
    ActiveSetResult
        The solution, or the last iterate.
    """
    rows, friction = problem.constraints.inequality, problem.constraints.friction
    rubs = bool(_counts(problem, np.zeros(rows.size, dtype=bool), sites=problem.radius > 0.0)[-1])
    progress, pivots, previous_sets = _Progress(), _SinglePivots(), list[Mask]()
    gradient, resume, turns = problem.c, isinstance(start, PCPGIterate), False
    # contact alone balances no load that friction holds
    if isinstance(start, np.ndarray) and not rubs and not _counts(problem, signs.active)[0]:
        pressing = problem.feasible[rows]
        start = start.copy()
        start[rows] += pressing
        signs = replace(signs, active=pressing > 0.0)
    # the violation of signs in units of energy: F ~ ||PFP|| at worst
    negligible = tolerance * np.sqrt(problem.norm)
    while True:
        face = close_first_gaps(problem, signs, gradient)
        start = iterate = pcpg(
            problem,
            face,
            start,
            tolerance=tolerance,
            sign_factor=0.0 if pivots.active else progress.sign_factor,
            max_products=max_products,
            products=products,
            resume=resume,
        )
        gradient = _without_pulling_rows(problem, face, iterate)
        following = iterate.multipliers[rows] > gradient[rows] / problem.norm
        forces = friction_step(problem, face, iterate.multipliers, gradient)
        rubbing = np.zeros_like(gradient)
        rubbing[friction.flat] = forces[friction.present]
        sticking = friction.sticking(rubbing, problem.radius)
        changed, size, turned = _counts(
            problem,
            following != face.signs.active,
            face.signs.active,
            sites=sticking != face.signs.sticking,
        )
        changed += turned
        monitor(ActiveSetStep(products.total, iterate.residual, size, changed))
        exact = iterate.energy <= tolerance
        nearly = exact and iterate.violation <= negligible
        # slips beside their forces: one more step of Newton's method
        turns = (
            nearly and rubs and not turns and unused_friction(problem, face, iterate) > tolerance
        )
        solved = nearly and not turns and closable(problem, face.signs, iterate.multipliers) is None
        # sets with other directions of friction forces may come back
        cycles = (
            exact
            and not rubs
            and any(_counts(problem, following != s)[0] == 0 for s in previous_sets)
        )
        progress.update(iterate.violation)
        stuck = cycles or progress.stagnates
        if (
            solved
            or iterate.at_limit
            or products.total >= max_products
            or interruption.agreed()
            or (stuck and rubs)
            or not pivots.update(changed, stuck)
        ):
            return active_set_result(problem, iterate, solved)
        if pivots.active:
            following = _change_last(problem, face.signs.active, following)
            progress, previous_sets = _Progress(), []
        elif exact:
            previous_sets.append(face.signs.active)
        signs = _signs(problem, following, sticking, rubbing, gradient)
        without = closable(problem, signs, iterate.multipliers)
        if without is not None:
            signs = _signs(problem, without.active, without.sticking, without.forces, gradient)
        # a face that is solved exactly makes no more progress: its directions have to change
        resume = (
            changed == 0
            and without is None
            and not (rubs and (exact or _turned(problem, face, iterate, forces)))
        )
        if resume:
            signs = replace(face.signs, active=following)


@dataclass
class _SinglePivots:
    """When one row changes at a time: from a cycle on, until fewer signs are wrong than ever.

    Attributes
    ----------
    active : bool
        Whether one row changes.
    fewest : int
        Smallest number of wrong signs at the beginning and the end of such changes.
    steps : int
        Changes of one row.
    """

    active: bool = False
    fewest: int = np.iinfo(np.int64).max
    steps: int = 0

    def update(self, changed: int, stuck: bool) -> bool:
        """Take in the number of wrong signs, and whether it is stuck; tell whether it goes on."""
        if self.active and changed < self.fewest:
            self.active, self.fewest = False, changed
        elif stuck and not self.active and changed:
            self.active, self.fewest = True, min(self.fewest, changed)
        self.steps += self.active
        return self.steps <= _SINGLE_STEPS and (self.active or not stuck)


@dataclass
class _Progress:
    """The decrease of the violation of signs from face to face.

    Attributes
    ----------
    sign_factor : float
        Accuracy of the faces relative to the violation; halved where the violation does not
        decrease, since signs may have been judged by inaccurate solutions.
    """

    sign_factor: float = 1.0
    best: float = np.inf
    failures: int = field(default=0)

    def update(self, violation: float) -> None:
        """Compare with the smallest violation so far."""
        if violation < 0.7 * self.best:
            self.best, self.failures = violation, 0
        else:
            self.sign_factor, self.failures = 0.5 * self.sign_factor, self.failures + 1

    @property
    def stagnates(self) -> bool:
        """Whether the violation has not decreased for more than eight faces."""
        return self.failures > 8


def _without_pulling_rows(problem: DualProblem, face: Face, iterate: PCPGIterate) -> Vector:
    """Return the gradient after the motion with the least penetration of what pushes do not hold.

    Rows that pull will leave the set. The position of a body that only they hold is no more known
    than that of a loose one.
    """
    constraints, active = problem.constraints, face.signs.active
    forces = iterate.multipliers[constraints.inequality]
    largest = float(constraints.layout.comm.allreduce(forces.max(initial=0.0), MPI.MAX))
    pushing = active & (forces > _NO_FORCE * largest)
    everywhere = np.ones(constraints.friction.size, dtype=bool)
    pulling, sites = _counts(problem, active & ~pushing, sites=everywhere)
    if sites or not pulling:
        return iterate.judged
    rows = constraints.face(pushing, np.zeros(0, dtype=bool))
    loose = LooseBodies.without(problem.coarse_space, rows)
    return iterate.judged if loose is None else loose.settled(iterate.judged)


def active_set_result(problem: DualProblem, iterate: PCPGIterate, solved: bool) -> ActiveSetResult:
    """Return an iterate with feasible multipliers."""
    none = np.zeros_like(iterate.multipliers)
    multipliers = problem.multiplier_set(none).project(iterate.multipliers.copy())
    return ActiveSetResult(multipliers, problem.projector.Q(iterate.gradient), solved, iterate)


def _counts(problem: DualProblem, *masks: Mask, sites: Mask | None = None) -> list[int]:
    """Count masks over the inequality rows, and one over sites, of all ranks; one reduction."""
    owned, friction = problem.constraints.owned_inequalities, problem.constraints.friction
    part = [float(np.count_nonzero(mask[:owned])) for mask in masks]
    if sites is not None:
        mine = friction.owned(problem.constraints.layout.owned)
        part.append(float(np.count_nonzero(sites & mine)))
    return [int(n) for n in problem.space.sums(*part)]


def unused_friction(problem: DualProblem, face: Face, iterate: PCPGIterate) -> float:
    """Return the square root of the sum of 2 (r |s| - l_T's) over the sites that slip. Collective.

    It is part of the error of the displacement; zero where slips s are along the forces.
    """
    friction = problem.constraints.friction
    slips, along = -friction.at_sites(iterate.gradient), friction.directions(iterate.multipliers)
    unused = problem.radius * friction.misaligned(slips, along)
    counted = ~face.signs.sticking & friction.owned(problem.constraints.layout.owned)
    return float(np.sqrt(2.0 * max(problem.space.sums(float(unused @ counted))[0], 0.0)))


def _turned(problem: DualProblem, face: Face, iterate: PCPGIterate, forces: Vector) -> bool:
    """Tell whether the forces of slips change by more than the residual on the face. Collective."""
    friction = problem.constraints.friction
    change = np.zeros_like(iterate.gradient)
    slipping = friction.present & ~face.signs.sticking[:, None]
    change[friction.rows[slipping]] = (forces - friction.at_sites(face.signs.forces))[slipping]
    return problem.norm * problem.space.norm(change) > iterate.residual


def _change_last(problem: DualProblem, active: Mask, following: Mask) -> Mask:
    """Return the set in which only the row with the largest number is that of the following set."""
    layout, rows = problem.constraints.layout, problem.constraints.inequality
    numbers = layout.numbers[rows]
    last = int(numbers[following != active].max(initial=-1))
    one: Mask = active ^ (numbers == layout.comm.allreduce(last, MPI.MAX))
    return one


def close_first_gaps(problem: DualProblem, signs: Signs, gradient: Vector) -> Face:
    """Return the face of a set, with the rows added that bodies close when the load moves them.

    Where the load does work on motions that the rows leave free, the bodies move until the first
    gaps close, or the first slips are taken back; these rows join the set, and so on until the load
    is balanced.

    Parameters
    ----------
    problem : DualProblem
        The dual problem.
    signs : Signs
        The set.
    gradient : (m,) array
        On contact rows the gap, scaled as the row; negative gaps count as closed. On tangential
        rows minus the slip.

    Returns
    -------
    Face
        The set with the rows that closed, its projector and preconditioner.
    """
    coarse_space, friction = problem.coarse_space, problem.constraints.friction
    gap = np.maximum(gradient[problem.constraints.inequality], 0.0)
    along = friction.directions(signs.forces)
    slip = np.maximum(np.sum(-friction.at_sites(gradient) * along, axis=1), 0.0)
    active, sticking = signs.active, signs.sticking
    while True:
        across = friction.across(signs.forces, sticking)
        projector = Projector.build(coarse_space, active, sticking, across)
        signs = replace(signs, active=active, sticking=sticking)
        work = projector.unresisted(_load(problem, signs), problem.e_size)
        if not work.any():
            return Face.build(problem, signs, projector)
        speed = coarse_space.contact.T @ work
        closing = ~active & (speed > NO_WORK * np.linalg.norm(work))
        way = np.divide(gap, speed, out=np.full(gap.size, np.inf), where=closing)
        back = -np.sum(friction.at_sites(coarse_space.friction.T @ work) * along, axis=1)
        returning = ~sticking & (back > NO_WORK * np.linalg.norm(work))
        way_back = np.divide(slip, back, out=np.full(slip.size, np.inf), where=returning)
        nearest = min(way.min(initial=np.inf), way_back.min(initial=np.inf))
        first = problem.space.dots_and_min(value=float(nearest))[0]
        if not np.isfinite(first):
            return Face.build(problem, signs, projector)
        # rows that close at once, up to rounding, join together
        active = active | (way <= first * (1.0 + NO_WORK))
        sticking = sticking | (way_back <= first * (1.0 + NO_WORK))
        gap = np.where(active, 0.0, np.maximum(gap - first * speed, 0.0))
        slip = np.maximum(slip - first * back, 0.0)


def _signs(
    problem: DualProblem, active: Mask, sticking: Mask, forces: Vector, gradient: Vector
) -> Signs:
    """Return a set with the curvature that the slips of a gradient have along the forces."""
    friction = problem.constraints.friction
    slips = -friction.at_sites(gradient)
    return Signs(active, sticking, forces, friction.curvature(forces, slips, problem.radius))


def _load(problem: DualProblem, signs: Signs) -> Vector:
    """Return e without what the forces of slips carry."""
    fixed = problem.constraints.friction.off_face(signs.sticking, signs.forces)
    carried = problem.space.sums(float(np.count_nonzero(fixed)))[0]
    return problem.e - problem.coarse_space.restrict(fixed) if carried else problem.e
