"""Primal-dual active set (semismooth Newton) on the dual.

Each step takes the contact rows that press as equalities, the others as no rows at all, and solves
that linear problem with the projector of just these rows (`face.py`). The signs of forces and gaps
give the next set. Few steps lead to the solution where they do, but the loop may cycle: it then
stops, and SMALBE-M, which cannot, goes on from where it came.

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.dual.pcpg import DualProblem, FaceSolution, solve_on_face
from fenics_tfeti.qp import Products

__all__ = ["ActiveSetEnd", "ActiveSetStep", "primal_dual_active_set"]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# how much more accurate than before faces are solved when the signs do not get better
_SHARPER = 0.5
# the violation of signs has to fall by this factor, or else so many faces may follow without
_PROGRESS = 0.7
_PATIENCE = 8
# relative to ||e||: work on motions that a face leaves free that counts as none
_NO_WORK = 1e-9
# relative to the motion: a row that does not close
_NO_SPEED = 1e-9
# relative: rows that close at once
_AT_ONCE = 1e-9


@dataclass(frozen=True)
class ActiveSetStep:
    """Where one face of the primal-dual active set method ended.

    Attributes
    ----------
    products : int
        Products so far.
    residual : float
        Norm of the projected residual on the face, relative to ||b||.
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
class ActiveSetEnd:
    """Where the active set method ended.

    Attributes
    ----------
    multipliers : (m,) array
        Nonnegative on the inequality rows, and G l = e up to what cutting negative forces does.
    coarse_gradient : (m,) array
        Q(Fl - d) + G'a with the rigid motions a: the equalities' part of the gradient.
    solved : bool
        Whether residual and signs are as they should be; else the set was there before, or a limit
        was met.
    face : FaceSolution
        The last face, from where to go on to a smaller tolerance.
    """

    multipliers: Vector
    coarse_gradient: Vector
    solved: bool
    face: FaceSolution


def primal_dual_active_set(
    problem: DualProblem,
    start: Vector | FaceSolution,
    active: Mask,
    *,
    tolerance: float,
    norm_b: float,
    max_products: int,
    products: Products,
    monitor: Callable[[ActiveSetStep], None],
) -> ActiveSetEnd:
    """Run the active set method until its set does not change, or it cycles.

    Parameters
    ----------
    problem : DualProblem
        The problem.
    start : (m,) array or FaceSolution
        Multipliers to start from, or the end of an earlier run to a larger tolerance.
    active : (i,) bool array
        The first guess of the inequality rows that are active; of an earlier run, its last.
    tolerance, norm_b : float
        Norm of the projected residual to end with, and the scale of the first ones.
    max_products : int
        Limit.
    products : Products
        Counter to add to.
    monitor : callable
        Called with every `ActiveSetStep`.

    Returns
    -------
    ActiveSetEnd
        The solution, or where the method has come to.
    """
    space = problem.space
    rows = space.constraints.inequality
    seen: list[Mask] = []
    accuracy, best, failures = 1.0, np.inf, 0
    room = space.constraints.rhs[rows]
    resume = isinstance(start, FaceSolution)
    while True:
        face, active = _face(problem, active, room)
        start = iterate = solve_on_face(
            face, active, problem, start, (accuracy, tolerance), max_products, products, resume
        )
        multipliers, room = iterate.multipliers, iterate.gradient[rows]
        following = multipliers[rows] > iterate.gradient[rows] / problem.norm
        changed, size = _counts(space, following != active, active)
        monitor(ActiveSetStep(products.total, iterate.residual / norm_b, size, changed))
        exact = iterate.residual <= tolerance
        solved = exact and iterate.violation <= tolerance
        cycles = exact and any(not _counts(space, following != s, s)[0] for s in seen)
        if iterate.violation < _PROGRESS * best:
            best, failures = iterate.violation, 0
        else:
            # perhaps the faces were judged by too rough solutions
            accuracy, failures = _SHARPER * accuracy, failures + 1
        hopeless = cycles or failures > _PATIENCE or products.total >= max_products
        if solved or hopeless:
            pressing = multipliers.copy()
            pressing[rows] = np.maximum(pressing[rows], 0.0)
            coarse_gradient = problem.projector.coarse(iterate.gradient)
            return ActiveSetEnd(pressing, coarse_gradient, solved, iterate)
        if exact:
            seen.append(active)
        active, resume = following, changed == 0


def _counts(space: CoarseSpace, *masks: Mask) -> list[int]:
    """Count the entries of masks over the inequality rows of all ranks."""
    owned = space.constraints.owned_inequalities
    part = np.array([float(np.count_nonzero(mask[:owned])) for mask in masks])
    return [int(n) for n in space.constraints.multipliers.space.sums(*part)]


def _face(problem: DualProblem, active: Mask, room: Vector) -> tuple[Projector, Mask]:
    """Return the projector of the equality and active rows, and the set.

    Where the load would push bodies along motions that these rows leave free, the bodies move until
    the first rows close; these join the set, and so on until the load is balanced.

    Parameters
    ----------
    problem : DualProblem
        The problem.
    active : (i,) bool array
        Rows of the face.
    room : (i,) array
        How far each row is from closing; negative numbers count as none.
    """
    space, constraints = problem.space, problem.space.constraints
    vectors = constraints.multipliers.space
    scale = float(np.linalg.norm(problem.e))
    room = np.maximum(room, 0.0)
    while True:
        face = Projector.build(space, active)
        work = face.free.T @ problem.e
        if np.linalg.norm(work) <= _NO_WORK * scale:
            return face, active
        speed = space.contact.T @ (face.free @ work)
        closing = ~active & (speed > _NO_SPEED * np.linalg.norm(work))
        way = np.divide(room, speed, out=np.full(room.size, np.inf), where=closing)
        first = vectors.dots_and_min(value=float(way.min(initial=np.inf)))[0]
        if not np.isfinite(first):
            return face, active
        active = active | (way <= first * (1.0 + _AT_ONCE))
        room = np.where(active, 0.0, np.maximum(room - first * speed, 0.0))
