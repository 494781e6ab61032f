"""PCPG: preconditioned conjugate projected gradients on a face of the dual feasible set.

On a face the active contact rows are equalities and the multipliers of the others vanish:

    minimise 1/2 l'Fl - d'l  subject to  Gl = e,  l = o off the face,

with G and the projector P of the rows on the face. The gradient is kept on *all* rows, as
g = Fl - d + G'a with the rigid motions a of the face: where l = o it is the gap that is left, whose
sign tells whether the face is the right one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import Products

__all__ = ["Face", "PCPGIterate", "pcpg"]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Face:
    """A face of the dual feasible set.

    Attributes
    ----------
    active : (i,) bool array
        The inequality rows on the face.
    projector : Projector
        P and Q of the equality rows and the active rows.
    """

    active: Mask
    projector: Projector


@dataclass(frozen=True)
class PCPGIterate:
    """An iterate on a face, with what the next step needs.

    Attributes
    ----------
    active : (i,) bool array
        The inequality rows on the face.
    multipliers : (m,) array
        l, with Gl = e and zeros off the face.
    gradient : (m,) array
        Fl - d + G'a.
    residual : float
        ||P(d - Fl)|| on the face.
    violation : float
        Norm of negative forces (times ||PFP||) on the face and negative gaps off it.
    direction : (m,) array
        The last search direction.
    rz : float
        r'z of the residual from which the direction was made.
    step_lengths : tuple of float
        Step lengths of the conjugate gradients.
    """

    active: Mask
    multipliers: Vector
    gradient: Vector
    residual: float
    violation: float
    direction: Vector
    rz: float
    step_lengths: tuple[float, ...]

    @property
    def step_length(self) -> float:
        """A typical step length."""
        return float(np.median(self.step_lengths)) if self.step_lengths else 0.0


def pcpg(
    problem: DualProblem,
    face: Face,
    start: Vector | PCPGIterate,
    *,
    tolerance: float,
    sign_factor: float,
    max_products: int,
    products: Products,
    resume: bool = False,
) -> PCPGIterate:
    """Minimise on a face until its signs are known well enough.

    The iterations end when the residual is below `sign_factor` times the violation of the signs of
    forces and gaps (more accuracy would be spent on the wrong face), or below `tolerance`. The
    signs are tested each time the residual has halved.

    Parameters
    ----------
    problem : DualProblem
        The dual problem (11.36).
    face : Face
        The face.
    start : (m,) array or PCPGIterate
        Multipliers, or the last iterate on another face.
    tolerance : float
        Absolute tolerance of the residual.
    sign_factor : float
        Tolerance of the residual relative to the violation; 0 where the signs do not matter.
    max_products : int
        Limit on `products`.
    products : Products
        Counter to add to.
    resume : bool
        Continue the conjugate gradients that ended in `start`, on the same face.

    Returns
    -------
    PCPGIterate
        The last iterate.
    """
    iterate = start if resume and isinstance(start, PCPGIterate) else None
    if iterate is None:
        iterate = _first_iterate(problem, face, start, products)
    test_below = max(tolerance, 0.5 * iterate.residual)
    while True:
        exhausted = products.total >= max_products
        if iterate.residual <= test_below or exhausted:
            if exhausted or iterate.residual <= max(sign_factor * iterate.violation, tolerance):
                return iterate
            test_below = max(tolerance, 0.5 * iterate.residual)
        following = _step(problem, face, iterate, products)
        if following is None:
            return iterate
        iterate = following


def _step(
    problem: DualProblem, face: Face, iterate: PCPGIterate, products: Products
) -> PCPGIterate | None:
    """Take one step of PCPG; return None where the curvature is not more than rounding."""
    l, g = iterate.multipliers, iterate.gradient
    # 1. precondition and project: r = -g on the face, z = P M r
    r = -face.projector.on_rows(g)
    z, rz = _precondition(problem, face, r, products)
    rz = iterate.residual**2 if rz is None else rz
    # 2. direction: p = z + (r'z / r'z of the last step) p
    p = z + rz / iterate.rz * iterate.direction
    # 3. product: PFp on the face, off it what the gaps change by; p'Fp
    change, curvature = face.projector.remove_rigid_motion(_product(problem, p, products), p)
    if curvature <= 0.0:
        return None
    # 4. step: l += alpha p, g += alpha PFp with alpha = r'z / p'Fp
    alpha = rz / curvature
    l, g = l + alpha * p, g + alpha * change
    lengths = (*iterate.step_lengths, alpha)
    return PCPGIterate(face.active, l, g, *_norms(problem, face, l, g), p, rz, lengths)


def _first_iterate(
    problem: DualProblem, face: Face, start: Vector | PCPGIterate, products: Products
) -> PCPGIterate:
    """Return the iterate nearest to the start with Gl = e and nothing off the face; one product."""
    if not isinstance(start, PCPGIterate):
        l = _nearest_on_face(problem, face, start)
        return _iterate_at(problem, face, l, np.zeros_like(l), -problem.d, (), products)
    # from another face, with a preconditioned step by the residual there: no product of its own
    alpha, r = start.step_length, -face.projector.on_rows(start.gradient)
    z = _precondition(problem, face, face.projector.P(r), products)[0]
    l = _nearest_on_face(problem, face, start.multipliers) + alpha * z
    if face.projector.free.shape[1]:
        return _iterate_at(problem, face, l, np.zeros_like(l), -problem.d, (alpha,), products)
    # gradients of faces without free motions differ by G'a, which the projection removes
    return _iterate_at(problem, face, l, start.multipliers, start.gradient, (alpha,), products)


def _iterate_at(
    problem: DualProblem,
    face: Face,
    l: Vector,
    known_at: Vector,
    known: Vector,
    step_lengths: tuple[float, ...],
    products: Products,
) -> PCPGIterate:
    """Return the iterate at l, from the known gradient at other multipliers; one product."""
    part = _product(problem, l - known_at, products)
    part = part + problem.constraints.layout.owned_part(known)
    g = face.projector.remove_rigid_motion(part, l)[0]
    none = np.zeros_like(l)
    return PCPGIterate(face.active, l, g, *_norms(problem, face, l, g), none, 1.0, step_lengths)


def _nearest_on_face(problem: DualProblem, face: Face, multipliers: Vector) -> Vector:
    """Return the nearest multipliers with Gl = e and zeros off the face."""
    projector = face.projector
    l = projector.on_rows(multipliers)
    missing = problem.e - problem.coarse_space.restrict(l)
    nearest: Vector = l + projector.least_norm(projector.without_free_motions(missing))
    return nearest


def _product(problem: DualProblem, x: Vector, products: Products) -> Vector:
    products.cg += 1
    return problem.F(x)


def _precondition(
    problem: DualProblem, face: Face, r: Vector, products: Products
) -> tuple[Vector, float | None]:
    """Return z = PMr and r'z; None for the latter where it would cost a reduction."""
    if problem.precondition is None:
        return r, None
    products.preconditioner += 1
    return face.projector.P_of_sum(problem.precondition(r), r)


def _norms(
    problem: DualProblem, face: Face, multipliers: Vector, gradient: Vector
) -> tuple[float, float]:
    """Return the norms of the residual and of what violates the signs; one reduction."""
    rows = problem.constraints.inequality
    wrong = np.zeros_like(gradient)
    force = problem.norm * multipliers[rows]
    wrong[rows] = np.minimum(np.where(face.active, force, gradient[rows]), 0.0)
    residual = face.projector.on_rows(gradient)
    squares = problem.space.dots((residual, residual), (wrong, wrong))
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))
