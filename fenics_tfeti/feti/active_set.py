"""Primal-dual active set (semismooth Newton) on the dual, with projected conjugate gradients.

Each step takes the contact rows that press as equalities, the others as no rows at all, and solves
that linear problem by projected conjugate gradients, with the projector of just these rows. The
signs of forces and gaps give the next set, and a face is left as soon as they violate more than is
left to solve on it. Few steps lead to the solution where they do, but the loop may cycle: it then
stops, and SMALBE-M, which cannot, goes on from where it came.

After Hintermueller, Ito, Kunisch, SIAM J. Optim. 13 (2002) 865-888.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse import CoarseSpace, Projector
from fenics_tfeti.feti.exchange import concatenate_ranks
from fenics_tfeti.qp import Products

__all__ = [
    "ActiveSetStep",
    "DualProblem",
    "FaceSolution",
    "primal_dual_active_set",
    "solve_on_face",
]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A face is left when its residual is below this part of what rows with the wrong sign violate.
_BALANCE = 0.3
_MAX_FACES = 40
# relative to ||e||: work on motions that a face leaves free that counts as none
_NO_WORK = 1e-9


@dataclass(frozen=True)
class DualProblem:
    """Minimise 1/2 l'Fl - d'l subject to Gl = e and l_I >= o, (11.35).

    Attributes
    ----------
    F : callable
        The dual operator.
    d : (m,) array
        Its load.
    e : (coarse,) array
        R'f of all subdomains.
    projector : Projector
        That of all rows.
    norm : float
        ||PFP||.
    precondition : callable or None
        x -> B_D S B_D'x.
    """

    F: Callable[[Vector], Vector]
    d: Vector
    e: Vector
    projector: Projector
    norm: float
    precondition: Callable[[Vector], Vector] | None

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
    """The solution of the linear problem on a face.

    Attributes
    ----------
    multipliers : (m,) array
        l, with Gl = e and zeros off the face.
    gradient : (m,) array
        Fl - d + G'a with the rigid motions a; in the end not negative where l = o.
    coarse_gradient : (m,) array
        Q(Fl - d) + G'a, the equalities' part of it.
    residual : float
        Norm of the projected residual on the face.
    Fl : (m,) array
        The product with the multipliers.
    step_length : float
        A typical step length of the conjugate gradients.
    """

    multipliers: Vector
    gradient: Vector
    coarse_gradient: Vector
    residual: float
    Fl: Vector
    step_length: float


def primal_dual_active_set(
    problem: DualProblem,
    multipliers: Vector,
    active: Mask,
    *,
    tolerance: float,
    norm_b: float,
    max_products: int,
    products: Products,
    monitor: Callable[[ActiveSetStep], None],
) -> FaceSolution:
    """Run the active set method until its set does not change, or it cycles.

    Parameters
    ----------
    problem : DualProblem
        The problem.
    multipliers : (m,) array
        Where to start from.
    active : (i,) bool array
        The first guess of the inequality rows that are active.
    tolerance, norm_b : float
        Norm of the projected residual to end with, and the scale of those told to `monitor`.
    max_products : int
        Limit.
    products : Products
        Counter to add to.
    monitor : callable
        Called with every `ActiveSetStep`.

    Returns
    -------
    FaceSolution
        That of the last face; solves the problem unless the sets cycle or a limit is met.
    """
    space = problem.space
    seen: list[Mask] = []
    solution: FaceSolution | None = None
    leave_early = True
    while True:
        face, active = _face(problem, active)
        solution = solve_on_face(
            face,
            problem,
            multipliers if solution is None else solution,
            tolerance,
            max_products,
            products,
            active if leave_early else None,
        )
        following = _following(problem, solution.multipliers, solution.gradient)
        changed, size = _counts(space, following != active, active)
        monitor(ActiveSetStep(products.total, solution.residual / norm_b, size, changed))
        seen.append(active)
        repeats = 0 in _counts(space, *(following != mask for mask in seen))
        done = changed == 0 and solution.residual <= tolerance
        stuck = (repeats and not leave_early) or len(seen) >= _MAX_FACES
        if done or stuck or products.total >= max_products:
            return solution
        if repeats:  # perhaps only for faces were left too early
            leave_early, seen = False, []
        active = following


def _following(problem: DualProblem, multipliers: Vector, gradient: Vector) -> Mask:
    """Return the active set that the signs of forces and gaps tell."""
    rows = problem.space.constraints.inequality
    pressing: Mask = multipliers[rows] > gradient[rows] / problem.norm
    return pressing


def _violation(problem: DualProblem, multipliers: Vector, gradient: Vector, active: Mask) -> float:
    """Return the norm of what the rows violate that enter or leave the set, as a gradient."""
    constraints = problem.space.constraints
    changes = _following(problem, multipliers, gradient) != active
    rows = constraints.inequality
    wrong = np.minimum(problem.norm * multipliers[rows], gradient[rows])
    wrong = np.where(changes, wrong, 0.0)[: constraints.owned_inequalities]
    return float(np.sqrt(constraints.multipliers.space.sums(float(wrong @ wrong))[0]))


def _counts(space: CoarseSpace, *masks: Mask) -> list[int]:
    """Count the entries of masks over the inequality rows of all ranks."""
    owned = space.constraints.owned_inequalities
    part = np.array([float(np.count_nonzero(mask[:owned])) for mask in masks])
    return [int(n) for n in space.constraints.multipliers.space.sums(*part)]


def _face(problem: DualProblem, active: Mask) -> tuple[Projector, Mask]:
    """Return the projector of the equality and active rows, and the set.

    Where the load would push bodies along motions that these rows leave free, the rows that the
    motions close join them.
    """
    space, constraints = problem.space, problem.space.constraints
    scale = float(np.linalg.norm(problem.e))
    while True:
        columns = constraints.equality
        columns[constraints.inequality] = active
        face = Projector.build(space, columns)
        work = face.free.T @ problem.e
        if np.linalg.norm(work) <= _NO_WORK * scale:
            return face, active
        closing = (space.all.T @ (face.free @ work))[constraints.inequality] > 0.0
        joining = closing & ~active
        if _counts(space, joining)[0] == 0:
            return face, active
        active = active | joining


def solve_on_face(
    face: Projector,
    problem: DualProblem,
    start: Vector | FaceSolution,
    tolerance: float,
    max_products: int,
    products: Products,
    active: Mask | None = None,
) -> FaceSolution:
    """Solve the linear problem on a face by projected, preconditioned conjugate gradients.

    Minimise 1/2 l'Fl - d'l subject to Gl = e and l = o off the face.

    Parameters
    ----------
    face : Projector
        That of the rows on the face.
    problem : DualProblem
        The problem.
    start : (m,) array or FaceSolution
        Multipliers to start from, or where another face ended.
    tolerance : float
        Norm of the projected residual to end with.
    max_products : int
        Limit on `products`.
    products : Products
        Counter to add to.
    active : (i,) bool array, optional
        The inequality rows on the face, to leave it early when their signs are clearly wrong.
    """
    inner = problem.space.constraints.multipliers.space
    inside = face.columns

    def split(x: Vector) -> tuple[Vector, Vector]:
        """Return Px on the face, and the coefficients of the rest."""
        a = face.coefficients(x)
        return np.where(inside, x, 0.0) - face.expand(a), a

    def precondition(r: Vector) -> Vector:
        if problem.precondition is None:
            return r
        products.preconditioner += 1
        return split(problem.precondition(r))[0]

    def product(x: Vector) -> Vector:
        products.cg += 1
        return problem.F(x)

    last = start if isinstance(start, FaceSolution) else None
    l = _nearest_on(face, problem, start.multipliers if isinstance(start, FaceSolution) else start)
    if last is not None and last.step_length > 0.0:
        # a first step at once, with the residual before the change: no product of its own
        l = l + last.step_length * precondition(split(problem.d - last.Fl)[0])
    Fl = product(l)
    r, a = split(problem.d - Fl)
    p = np.zeros_like(r)
    rz = 1.0
    lengths: list[float] = []
    residual = inner.norm(r)
    while residual > tolerance and products.total < max_products:
        if active is not None:
            gradient = Fl - problem.d + problem.space.all.T @ _resisted(face, a)
            if residual <= _BALANCE * _violation(problem, l, gradient, active):
                break
        z = precondition(r)
        before, rz = rz, inner.dots((r, z))[0]
        p = z + rz / before * p
        Fp = product(p)
        curvature = inner.dots((p, Fp))[0]
        if curvature <= 0.0:
            break
        lengths.append(rz / curvature)
        l, Fl = l + lengths[-1] * p, Fl + lengths[-1] * Fp
        PFp, change = split(Fp)
        r, a = r - lengths[-1] * PFp, a - lengths[-1] * change
        residual = inner.norm(r)
    if not lengths and last is not None:
        lengths = [last.step_length]
    # the smallest of the motions that the face leaves free
    pull = problem.space.all.T @ _resisted(face, face.coefficients(problem.d - Fl))
    jump = Fl - problem.d
    coarse_gradient = problem.projector.coarse(jump) + pull
    step_length = float(np.median(lengths)) if lengths else 0.0
    return FaceSolution(l, jump + pull, coarse_gradient, residual, Fl, step_length)


def _nearest_on(face: Projector, problem: DualProblem, multipliers: Vector) -> Vector:
    """Return the nearest multipliers with Gl = e and nothing off the face."""
    l = np.where(face.columns, multipliers, 0.0)
    missing = problem.e - concatenate_ranks(problem.space.comm, problem.space.own @ l)
    nearest: Vector = l + face.expand(face.solve(_resisted(face, missing)))
    return nearest


def _resisted(face: Projector, coarse: Vector) -> Vector:
    """Return a coarse vector without its part in the motions that the face leaves free."""
    part: Vector = coarse - face.free @ (face.free.T @ coarse)
    return part
