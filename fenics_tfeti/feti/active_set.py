"""Primal-dual active set (semismooth Newton) on the dual, with projected conjugate gradients.

Each step takes the contact rows that press as equalities, the others as no rows at all, and solves
that linear problem by projected conjugate gradients, with the projector of just these rows. The
signs of forces and gaps give the next set. Few steps lead to the solution where they do, but the
loop may cycle: it then stops, and SMALBE-M, which cannot, goes on from where it came.

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse import CoarseSpace, Projector
from fenics_tfeti.qp import Products

__all__ = [
    "ActiveSetEnd",
    "ActiveSetStep",
    "DualProblem",
    "FaceSolution",
    "primal_dual_active_set",
    "solve_on_face",
]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# reduction of the residual after which the signs are looked at
_LOOK = 0.5
# the violation of signs has to fall by this factor, or else so many faces may follow without
_PROGRESS = 0.7
_PATIENCE = 8
# unit of rounding of the products in single precision, and how small the residual may get
# relative to what they leave in it before it is replaced (van der Vorst and Ye, SIAM J. Sci.
# Comput. 22 (2000) 835-852)
_SINGLE = 2.0**-24
_TRUSTED = 100.0
# relative to ||e||: work on motions that a face leaves free that counts as none
_NO_WORK = 1e-9
# relative to the motion: a row that does not close
_NO_SPEED = 1e-9
# relative: rows that close at once
_AT_ONCE = 1e-9


@dataclass(frozen=True)
class DualProblem:
    """Minimise 1/2 l'Fl - d'l subject to Gl = e and l_I >= o, (11.35).

    Attributes
    ----------
    F : callable
        x -> this rank's part of Fx, F the dual operator.
    d : (m,) array
        Its load.
    e : (coarse,) array
        R'f of all subdomains.
    projector : Projector
        That of all rows.
    norm : float
        ||PFP||, roughly: the scale of gaps by forces.
    precondition : callable or None
        x -> this rank's part of B_D S B_D'x.
    rough : callable or None
        As F, in single precision, where conjugate gradients are to use that.
    """

    F: Callable[[Vector], Vector]
    d: Vector
    e: Vector
    projector: Projector
    norm: float
    precondition: Callable[[Vector], Vector] | None
    rough: Callable[[Vector], Vector] | None = None

    @property
    def space(self) -> CoarseSpace:
        """G."""
        return self.projector.space


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
class FaceSolution:
    """A solution of the linear problem on a face.

    Attributes
    ----------
    active : (i,) bool array
        The inequality rows on the face.
    multipliers : (m,) array
        l, with Gl = e and zeros off the face.
    gradient : (m,) array
        Fl - d + G'a with the rigid motions a of the face; in the end not negative where l = o.
    residual : float
        Norm of the projected residual on the face.
    violation : float
        Norm of what the signs of forces and gaps violate, in units of the residual.
    step_length : float
        A typical step length of the conjugate gradients.
    drift : float
        Bound of what products in single precision have left in the gradient.
    direction, rz : (m,) array, float
        Their last direction, and r'z of the residual that it was made from: to go on with.
    """

    active: Mask
    multipliers: Vector
    gradient: Vector
    residual: float
    violation: float
    step_length: float
    drift: float
    direction: Vector
    rz: float


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
            accuracy, failures = _LOOK * accuracy, failures + 1
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


def solve_on_face(
    face: Projector,
    active: Mask,
    problem: DualProblem,
    start: Vector | FaceSolution,
    tolerances: tuple[float, float],
    max_products: int,
    products: Products,
    resume: bool = False,
) -> FaceSolution:
    """Solve the linear problem on a face by projected, preconditioned conjugate gradients.

    Minimise 1/2 l'Fl - d'l subject to Gl = e and l = o off the face. The face is left as soon as
    the residual is smaller than the violation of signs times the first tolerance, or than the
    second one: more accuracy would be spent on the wrong rows. The signs are looked at whenever the
    residual has halved.

    With F in single precision, the gradient is computed anew in double before the residual is as
    small as what rounding has left in it: what is added later belongs to small changes, and the
    accuracy is that of double (residual replacement, van der Vorst and Ye 2000).

    Parameters
    ----------
    face : Projector
        That of the rows on the face.
    active : (i,) bool array
        The inequality rows on it.
    problem : DualProblem
        The problem.
    start : (m,) array or FaceSolution
        Multipliers to start from, or where another face ended.
    tolerances : (float, float)
        Relative to the violation, and absolute. With zero for the first, the signs do not matter.
    max_products : int
        Limit on `products`.
    products : Products
        Counter to add to.
    resume : bool
        Go on with the conjugate gradients that ended in `start`, on the same face.
    """
    vectors = problem.space.constraints.multipliers
    accuracy, tolerance = tolerances
    rough, unit = (problem.F, 0.0) if problem.rough is None else (problem.rough, _SINGLE)

    def precondition(r: Vector) -> tuple[Vector, float | None]:
        """Return z and r'z; the latter where it does not cost a reduction more."""
        if problem.precondition is None:
            return r, None
        products.preconditioner += 1
        return face.complement_of_sum(problem.precondition(r), r)

    def onto_face() -> tuple[Vector, Vector, Vector, float, list[float]]:
        """Return the first l, where a gradient is known, it, its drift, and step lengths."""
        origin, known, drift = np.zeros_like(problem.d), -problem.d, 0.0
        if not isinstance(start, FaceSolution):
            return _nearest_on(face, problem, start), origin, known, drift, []
        # a first step at once, with the residual before the change: no product of its own
        step = precondition(-face.complement(face.keep(start.gradient)))[0]
        l = _nearest_on(face, problem, start.multipliers) + start.step_length * step
        # gradients of faces without free motions differ by G'a, which is taken out
        if face.free.shape[1] == 0:
            origin, known, drift = start.multipliers, start.gradient, start.drift
        return l, origin, known, drift, [start.step_length]

    if isinstance(start, FaceSolution) and resume:
        l, gradient, p, rz = start.multipliers, start.gradient, start.direction, start.rz
        drift, lengths = start.drift, [start.step_length]
        residual, violation = _norms(face, active, problem, l, gradient)
    else:
        l, origin, known, drift, lengths = onto_face()
        products.cg += 1
        gradient = face.relax(rough(l - origin) + vectors.owned_part(known), l)[0]
        p, rz = np.zeros_like(gradient), 1.0
        residual, violation, size = _norms(face, active, problem, l, gradient, gradient - known)
        drift += unit * size
    wanted = max(tolerance, _LOOK * residual)
    while True:
        if max(residual, tolerance) < _TRUSTED * drift and products.total < max_products:
            products.replacement += 1
            gradient = face.relax(problem.F(l) - vectors.owned_part(problem.d), l)[0]
            drift = 0.0
            residual, violation = _norms(face, active, problem, l, gradient)
        if residual <= wanted or products.total >= max_products:
            enough = max(accuracy * violation, tolerance)
            if residual <= enough or products.total >= max_products:
                break
            wanted = max(tolerance, _LOOK * residual)
        z, rMr = precondition(-face.keep(gradient))
        before, rz = rz, residual**2 if rMr is None else rMr
        p = z + rz / before * p
        products.cg += 1
        # on the face PFp, elsewhere what the gradient changes by
        change, curvature = face.relax(rough(p), p)
        if curvature <= 0.0:
            break
        lengths.append(rz / curvature)
        l, gradient = l + lengths[-1] * p, gradient + lengths[-1] * change
        residual, violation, size = _norms(face, active, problem, l, gradient, change)
        drift += unit * lengths[-1] * size
    typical = float(np.median(lengths)) if lengths else 0.0
    return FaceSolution(active, l, gradient, residual, violation, typical, drift, p, rz)


def _nearest_on(face: Projector, problem: DualProblem, multipliers: Vector) -> Vector:
    """Return the nearest multipliers with Gl = e and nothing off the face."""
    l = face.keep(multipliers)
    missing = problem.e - problem.space.restrict(l)
    nearest: Vector = l + face.expand(face.solve(face.resisted(missing)))
    return nearest


def _norms(
    face: Projector,
    active: Mask,
    problem: DualProblem,
    multipliers: Vector,
    gradient: Vector,
    *more: Vector,
) -> list[float]:
    """Return the norms of the residual, of what violates signs and of more; one reduction."""
    constraints = problem.space.constraints
    rows = constraints.inequality
    wrong = np.zeros_like(gradient)
    wrong[rows] = np.where(active, problem.norm * multipliers[rows], gradient[rows])
    vectors = (face.keep(gradient), np.minimum(wrong, 0.0), *more)
    return [
        float(np.sqrt(x)) for x in constraints.multipliers.space.dots(*((v, v) for v in vectors))
    ]
