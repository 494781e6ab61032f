"""Rigid bodies on springs whose forces are bounded, by a semismooth Newton method.

Bodies move by z until the forces P(Sz - g) of springs with gaps g, P the projection on a convex
set, and those of linear springs K balance a load l:

    minimise  h(Sz - g) + 1/2 z'Kz - l'z,   h(v) = v'P(v) - 1/2 ||P(v)||^2.

The gradient is S'P(Sz - g) + Kz - l. The proximal point method adds a small weight times the
squared distance to the last z, which makes the problem definite: of several solutions it finds one
near z = o. Without a solution, weight times distance tends to the smallest residual.

After Rockafellar, SIAM J. Control Optim. 14 (1976) 877-898, and Qi and Sun, Math. Program. 58
(1993) 353-367.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fenics_tfeti.qp.cones import FrictionCones
from fenics_tfeti.qp.feasible_set import ProductSet
from fenics_tfeti.typing import Vector

# weights of the distance, relative to the stiffness of the springs: what is nearest without a load;
# under a load, which may move bodies far, decreasing ones down to what factors resolve
_NEAREST = (1e-10, 1e-10, 1e-10)
_SPARSE = (1e-1, 1e-3, 1e-5, 1e-7, *_NEAREST)
_DENSE = (1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 1e-15, 1e-15, 1e-15)
# limits on Newton steps, on the bisections of each, and on the corrections of forces
_NEWTON_STEPS, _BISECTIONS, _CORRECTIONS = 60, 60, 20
# rounding of the gradient, relative to the sizes of its terms; residual that counts as none
_ROUNDING, _SOLVED = 2.0**-51, 1e-12


@dataclass(frozen=True)
class HalfLines:
    """The set of the x whose first components are at least 0; the others are free.

    Attributes
    ----------
    number : int
        Number of these components.
    """

    number: int

    def project(self, x: Vector) -> Vector:
        """Project x in place onto the set and return it."""
        x[: self.number] = np.maximum(x[: self.number], 0.0)
        return x

    def derivative_times(self, x: Vector, columns: Vector) -> Vector:
        """Return P'(x) columns for any x and columns (n, r); at 0 a generalized derivative."""
        return np.where(self._inside(x)[:, None], columns, 0.0)

    def derivative(self, x: Vector) -> sp.csr_matrix:
        """Return P'(x) as a sparse matrix."""
        return sp.diags(self._inside(x).astype(float), format="csr")

    def _inside(self, x: Vector) -> Vector:
        return np.append(x[: self.number] > 0.0, np.ones(x.size - self.number, dtype=bool))


ForceSet = HalfLines | FrictionCones | ProductSet


def _same(part: Any) -> Any:
    return part


def projected_newton(
    S: Vector | sp.csr_matrix,
    gap: Vector,
    feasible: ForceSet | None = None,
    *,
    basis: sp.csr_matrix | None = None,
    load: Vector | None = None,
    stiffness: sp.csr_matrix | None = None,
    sum_vectors: Callable[[Vector], Vector] = _same,
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix] = _same,
) -> Vector:
    """Minimise h(STz - gap) + 1/2 z'Kz - load'z.

    Parameters
    ----------
    S : (m, n) array or scipy.sparse.csr_matrix
        Closing of each spring by each motion; on several ranks this rank's springs.
    gap : (m,) array
        Gaps at z = o, negative where there is penetration.
    feasible : HalfLines, FrictionCones or ProductSet, optional
        The set of forces, which contains o; by default springs only push. A `ProductSet` takes an
        array S.
    basis : (n, k) scipy.sparse.csr_matrix, optional
        T: combinations of the motions; by default the motions themselves. Where its columns are
        full, S stays sparse.
    load : (k,) array, optional
        Forces on the motions; the same on all ranks.
    stiffness : (k, k) scipy.sparse.csr_matrix, optional
        K, positive semidefinite; the same on all ranks.
    sum_vectors, sum_matrices : callable
        Sums over the ranks of arrays and of sparse matrices (n, n).

    Returns
    -------
    (k,) array
        z, the same on all ranks.

    Examples
    --------
    A body between two walls, one of which it penetrates, and another one that is squeezed.

    >>> import numpy as np, scipy.sparse as sp
    >>> S = sp.csr_matrix([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    >>> projected_newton(S, np.array([-1.0, 3.0, -2.0, -1.0])).round(6).tolist()
    [-1.0, -0.5]
    """
    T = sp.identity(S.shape[1], format="csr") if basis is None else basis
    z = np.zeros(T.shape[1])
    K = sp.csr_matrix((z.size, z.size)) if stiffness is None else stiffness
    feasible = HalfLines(S.shape[0]) if feasible is None else feasible
    squares = S**2 if isinstance(S, np.ndarray) else S.multiply(S)
    diagonal = sum_vectors(np.asarray(squares.sum(axis=0)).ravel())
    problem = _Problem(
        S,
        T,
        gap,
        feasible,
        K,
        np.zeros_like(z) if load is None else load,
        float(np.append(diagonal, K.diagonal()).max(initial=0.0)),
        sum_vectors,
        sum_matrices,
    )
    size = float(np.linalg.norm(problem.at(z).gradient))
    if size == 0.0:
        return z
    if not problem.load.any():
        for relative in _NEAREST:
            z = _nearest(problem, z, relative * problem.stiffest)
        return z
    for relative in _SPARSE if sp.issparse(S) else _DENSE:
        weight = relative * problem.stiffest
        centre, z = z, _nearest(problem, z, weight)
        if weight * np.linalg.norm(z - centre) <= _SOLVED * size:
            break
    return z


@dataclass(frozen=True)
class _Point:
    """v = STz - g, the gradient, and what its rounding is relative to."""

    v: Vector
    gradient: Vector
    terms: float


@dataclass(frozen=True)
class _Problem:
    """What is minimised, see `projected_newton`."""

    S: Vector | sp.csr_matrix
    T: sp.csr_matrix
    gap: Vector
    feasible: ForceSet
    K: sp.csr_matrix
    load: Vector
    stiffest: float
    sum_vectors: Callable[[Vector], Vector]
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix]

    def at(self, z: Vector) -> _Point:
        """Return the gradient at z. Collective."""
        v = self.S @ (self.T @ z) - self.gap
        x = self.feasible.project(v.copy())
        sums = self.sum_vectors(np.append(self.S.T @ x, x @ x))
        gradient = self.T.T @ sums[:-1] + self.K @ z - self.load
        terms = np.sqrt(self.stiffest * sums[-1]) + self.stiffest * np.linalg.norm(z)
        return _Point(v, gradient, float(terms + np.linalg.norm(self.load)))

    def step(self, point: _Point, weight: float) -> Vector:
        """Return Newton's step for a gradient with the weight added. Collective."""
        if sp.issparse(self.S):
            assert not isinstance(self.feasible, ProductSet)
            H = (self.S.T @ self.feasible.derivative(point.v) @ self.S).tocsr()
            H = self.T.T @ self.sum_matrices(H) @ self.T + self.K
            H = (H + weight * sp.identity(self.load.size)).tocsc()
            symmetric = {"SymmetricMode": True}
            factor = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
            return -np.asarray(factor.solve(point.gradient))
        rows = self.S @ self.T
        H = rows.T @ self.feasible.derivative_times(point.v, rows) + self.K.toarray()
        return -np.linalg.solve(H + weight * np.identity(self.load.size), point.gradient)


def _nearest(problem: _Problem, centre: Vector, weight: float) -> Vector:
    """Minimise with weight/2 ||z - centre||^2 added. Collective."""

    def at(z: Vector) -> _Point:
        point = problem.at(z)
        return _Point(point.v, point.gradient + weight * (z - centre), point.terms)

    z, point = centre, at(centre)
    for _ in range(_NEWTON_STEPS):
        if np.linalg.norm(point.gradient) <= _ROUNDING * point.terms:
            break
        p = problem.step(point, weight)
        z, point = _less_steep(at, z, point, p)
    return z


def _less_steep(
    at: Callable[[Vector], _Point], z: Vector, point: _Point, p: Vector
) -> tuple[Vector, _Point]:
    """Return z + p, or a point on the way there that is at most half as steep along p.

    Slopes tell on which side of a kink the minimum is where differences of values are rounding.
    """
    low, high, t, limit = 0.0, 1.0, 1.0, 0.5 * abs(float(point.gradient @ p))
    following = at(z + p)
    if following.gradient @ p > limit:
        for _ in range(_BISECTIONS):
            t = 0.5 * (low + high)
            following = at(z + t * p)
            slope = float(following.gradient @ p)
            if abs(slope) <= limit:
                break
            low, high = (low, t) if slope > 0.0 else (t, high)
    return z + t * p, following
