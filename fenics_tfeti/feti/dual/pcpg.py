"""The linear problem on a face of the dual, by projected, preconditioned conjugate gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.qp import Products

__all__ = ["DualProblem", "FaceSolution", "solve_on_face"]

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

# reduction of the residual after which the signs are looked at
_LOOK = 0.5


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
class FaceSolution:
    """An iterate on a face; the last one is the solution.

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
    direction, rz : (m,) array, float
        The last direction, and r'z of the residual that it was made from.
    step_lengths : tuple of float
        Of the conjugate gradients.
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
    """Minimise 1/2 l'Fl - d'l subject to Gl = e and l = o off the face.

    The face is left as soon as the residual is smaller than the violation of signs times the first
    tolerance, or than the second one: more accuracy would be spent on the wrong rows. The signs are
    looked at whenever the residual has halved.

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

    Returns
    -------
    FaceSolution
        The last iterate.
    """
    accuracy, tolerance = tolerances
    descent = _Descent(face, active, problem, products)
    if not isinstance(start, FaceSolution):
        iterate = descent.first(start)
    else:
        iterate = start if resume else descent.entered(start)
    wanted = max(tolerance, _LOOK * iterate.residual)
    while True:
        exhausted = products.total >= max_products
        if iterate.residual <= wanted or exhausted:
            if exhausted or iterate.residual <= max(accuracy * iterate.violation, tolerance):
                return iterate
            wanted = max(tolerance, _LOOK * iterate.residual)
        following = descent.step(iterate)
        if following is None:
            return iterate
        iterate = following


@dataclass(frozen=True)
class _Descent:
    """Conjugate gradients on one face.

    Attributes
    ----------
    face : Projector
        That of the rows on the face.
    active : (i,) bool array
        The inequality rows on it.
    problem : DualProblem
        The problem.
    products : Products
        Counter.
    """

    face: Projector
    active: Mask
    problem: DualProblem
    products: Products

    def first(self, multipliers: Vector) -> FaceSolution:
        """Start from the nearest multipliers on the face."""
        l, none = self._nearest(multipliers), np.zeros_like(multipliers)
        return self._begin(l, none, -self.problem.d, ())

    def entered(self, before: FaceSolution) -> FaceSolution:
        """Start from another face, with a step by the residual there: no product of its own."""
        face, length = self.face, before.step_length
        step = self._precondition(-face.complement(face.keep(before.gradient)))[0]
        l = self._nearest(before.multipliers) + length * step
        if face.free.shape[1]:
            return self._begin(l, np.zeros_like(l), -self.problem.d, (length,))
        # gradients of faces without free motions differ by G'a, which is taken out
        return self._begin(l, before.multipliers, before.gradient, (length,))

    def step(self, iterate: FaceSolution) -> FaceSolution | None:
        """Take a step; None where the curvature is no more than rounding."""
        z, rMr = self._precondition(-self.face.keep(iterate.gradient))
        rz = iterate.residual**2 if rMr is None else rMr
        p = z + rz / iterate.rz * iterate.direction
        # on the face PFp, elsewhere what the gradient changes by
        change, curvature = self.face.relax(self._product(p), p)
        if curvature <= 0.0:
            return None
        length = rz / curvature
        l, gradient = iterate.multipliers + length * p, iterate.gradient + length * change
        residual, violation = self._norms(l, gradient)
        return FaceSolution(
            self.active,
            l,
            gradient,
            residual,
            violation,
            p,
            rz,
            (*iterate.step_lengths, length),
        )

    def _begin(
        self, l: Vector, origin: Vector, known: Vector, lengths: tuple[float, ...]
    ) -> FaceSolution:
        """Return the iterate at l, given the gradient at another place."""
        part = self.problem.space.constraints.multipliers.owned_part(known)
        gradient = self.face.relax(self._product(l - origin) + part, l)[0]
        residual, violation = self._norms(l, gradient)
        none = np.zeros_like(l)
        return FaceSolution(self.active, l, gradient, residual, violation, none, 1.0, lengths)

    def _product(self, x: Vector) -> Vector:
        self.products.cg += 1
        return self.problem.F(x)

    def _precondition(self, r: Vector) -> tuple[Vector, float | None]:
        """Return z and r'z; the latter where it does not cost a reduction more."""
        if self.problem.precondition is None:
            return r, None
        self.products.preconditioner += 1
        return self.face.complement_of_sum(self.problem.precondition(r), r)

    def _nearest(self, multipliers: Vector) -> Vector:
        """Return the nearest multipliers with Gl = e and nothing off the face."""
        face, problem = self.face, self.problem
        l = face.keep(multipliers)
        missing = problem.e - problem.space.restrict(l)
        nearest: Vector = l + face.expand(face.solve(face.resisted(missing)))
        return nearest

    def _norms(self, multipliers: Vector, gradient: Vector) -> list[float]:
        """Return the norms of the residual and of what violates signs; one reduction."""
        constraints = self.problem.space.constraints
        rows = constraints.inequality
        wrong = np.zeros_like(gradient)
        force = self.problem.norm * multipliers[rows]
        wrong[rows] = np.where(self.active, force, gradient[rows])
        vectors = (self.face.keep(gradient), np.minimum(wrong, 0.0))
        squares = constraints.multipliers.space.dots(*((v, v) for v in vectors))
        return [float(np.sqrt(x)) for x in squares]
