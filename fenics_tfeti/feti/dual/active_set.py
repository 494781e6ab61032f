"""Primal-dual active set method (semismooth Newton) for the dual problem (11.36).

Each step takes the active contact rows as equalities and drops the others, and solves that linear
problem by PCPG with the projector of these rows. The signs of forces and gaps give the next active
set. The method alone may cycle: then one row changes at a time, the last one with a wrong sign,
until fewer signs are wrong than before. For definite problems that ends (Murty's rule); where it
takes too long, SMALBE-M continues from the last iterate.

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888, and Judice, Pires, Comput.
Oper. Res. 21 (1994) 587-596.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti import interruption
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.constraints.coupling import null_space
from fenics_tfeti.feti.dual.pcpg import Face, PCPGIterate, pcpg
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.feti.tolerances import NO_WORK
from fenics_tfeti.qp import Products

__all__ = ["ActiveSetResult", "ActiveSetStep", "primal_dual_active_set"]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# limit on changes of one row
_SINGLE_STEPS = 100
# part of the gaps of dependent rows that is rounding
_CONSISTENT = 1e-9


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
        Rows that enter or leave the set after it.
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
        Nonnegative on the inequality rows, and G l = e except for what cutting negative forces
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
    active: Mask,
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
    active : (i,) bool array
        First active set; of an earlier run, its last one.
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
    rows = problem.constraints.inequality
    progress, pivots, previous_sets = _Progress(), _SinglePivots(), list[Mask]()
    gap, resume = problem.c[rows], isinstance(start, PCPGIterate)
    # the violation of signs in units of energy: F ~ ||PFP|| at worst
    negligible = tolerance * np.sqrt(problem.norm)
    while True:
        face = close_first_gaps(problem, active, gap)
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
        gap = iterate.gradient[rows]
        following = iterate.multipliers[rows] > gap / problem.norm
        changed, size = _counts(problem, following != face.active, face.active)
        monitor(ActiveSetStep(products.total, iterate.residual, size, changed))
        exact = iterate.energy <= tolerance
        solved = exact and iterate.violation <= negligible
        cycles = exact and any(_counts(problem, following != s)[0] == 0 for s in previous_sets)
        progress.update(iterate.violation)
        stuck = cycles or progress.stagnates
        if (
            solved
            or iterate.at_limit
            or products.total >= max_products
            or interruption.agreed()
            or not pivots.update(changed, stuck)
        ):
            return _result(problem, iterate, solved)
        if pivots.active:
            following = _change_last(problem, face.active, following)
            progress, previous_sets = _Progress(), []
        elif exact:
            previous_sets.append(face.active)
        resume = changed == 0
        active = without_dependent_rows(problem, following, iterate.multipliers)


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


def _result(problem: DualProblem, iterate: PCPGIterate, solved: bool) -> ActiveSetResult:
    rows = problem.constraints.inequality
    multipliers = iterate.multipliers.copy()
    multipliers[rows] = np.maximum(multipliers[rows], 0.0)
    return ActiveSetResult(multipliers, problem.projector.Q(iterate.gradient), solved, iterate)


def _counts(problem: DualProblem, *masks: Mask) -> list[int]:
    """Count the entries of masks over the inequality rows of all ranks; one reduction."""
    owned = problem.constraints.owned_inequalities
    part = np.array([float(np.count_nonzero(mask[:owned])) for mask in masks])
    return [int(n) for n in problem.space.sums(*part)]


def _change_last(problem: DualProblem, active: Mask, following: Mask) -> Mask:
    """Return the set in which only the row with the largest number is that of the following set."""
    layout, rows = problem.constraints.layout, problem.constraints.inequality
    numbers = layout.numbers[rows]
    last = int(numbers[following != active].max(initial=-1))
    one: Mask = active ^ (numbers == layout.comm.allreduce(last, MPI.MAX))
    return one


def without_dependent_rows(problem: DualProblem, active: Mask, multipliers: Vector) -> Mask:
    """Return a set without rows that depend on others of it and cannot be closed with them.

    At a node with more contacts than dimensions some combination y of rows vanishes, B'y = o. F
    does not see it, and c'y is the cost of moving along it: that is done, as in the simplex method,
    until the first force vanishes; its row leaves.

    Parameters
    ----------
    problem : DualProblem
        The dual problem.
    active : (i,) bool array
        The set.
    multipliers : (m,) array
        lambda; negative forces count as zero.

    Returns
    -------
    (i,) bool array
        A subset. Collective.
    """
    constraints, coupling = problem.constraints, problem.constraints.coupling
    if not coupling.groups:
        return active
    on_rows = constraints.on_inequalities(active)
    on_rows, forces, gaps = coupling.gather(on_rows, multipliers, problem.c)
    chosen = (on_rows > 0.0) | coupling.tied
    forces = np.maximum(forces, 0.0)
    for members in coupling.groups:
        W = coupling.gram[members][:, members].toarray()
        chosen[members] = _independent(
            W, chosen[members], forces[members], gaps[members], coupling.tied[members]
        )
    contact = ~coupling.tied[coupling.positions]
    active = active.copy()
    at = np.searchsorted(constraints.inequality, coupling.rows[contact])
    active[at] = chosen[coupling.positions[contact]]
    return active


def _independent(W: Vector, chosen: Mask, force: Vector, gap: Vector, tied: Mask) -> Mask:
    """Return the rows of one group that can be closed together; tied rows stay."""
    chosen = chosen.copy()
    while chosen.sum() > 1:
        at = np.flatnonzero(chosen)
        null = null_space(W[np.ix_(at, at)])
        y = -null @ (null.T @ gap[at])
        falling = ~tied[at] & (y < -_CONSISTENT * np.abs(y).max(initial=0.0))
        consistent = np.abs(y).max(initial=0.0) <= _CONSISTENT * np.abs(gap[at]).max()
        if consistent or not falling.any():
            break
        way = force[at[falling]] / -y[falling]
        force[at] = np.where(tied[at], force[at], np.maximum(force[at] + way.min() * y, 0.0))
        chosen[at[falling][np.argmin(way)]] = False
    return chosen


def close_first_gaps(problem: DualProblem, active: Mask, gap: Vector) -> Face:
    """Return the face of a set, with the rows added that bodies close when the load moves them.

    Where the load does work on motions that the rows leave free, the bodies move until the first
    gaps close; these rows join the set, and so on until the load is balanced.

    Parameters
    ----------
    problem : DualProblem
        The dual problem.
    active : (i,) bool array
        The set.
    gap : (i,) array
        Gap of each row, scaled as the row; negative gaps count as closed.

    Returns
    -------
    Face
        The set with the rows that closed, its projector and preconditioner.
    """
    coarse_space = problem.coarse_space
    gap = np.maximum(gap, 0.0)
    while True:
        projector = Projector.build(coarse_space, active)
        work = projector.unresisted(problem.e, problem.e_size)
        if not work.any():
            return Face.build(problem, active, projector)
        speed = coarse_space.contact.T @ work
        closing = ~active & (speed > NO_WORK * np.linalg.norm(work))
        way = np.divide(gap, speed, out=np.full(gap.size, np.inf), where=closing)
        first = problem.space.dots_and_min(value=float(way.min(initial=np.inf)))[0]
        if not np.isfinite(first):
            return Face.build(problem, active, projector)
        # rows that close at once, up to rounding, join together
        active = active | (way <= first * (1.0 + NO_WORK))
        gap = np.where(active, 0.0, np.maximum(gap - first * speed, 0.0))
