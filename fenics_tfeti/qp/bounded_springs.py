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
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fenics_tfeti.qp.feasible_set import Bounds, ProductSet
from fenics_tfeti.typing import Vector

# proximal weights relative to the largest spring stiffness. Without a load: three equal ones. Under
# a load, which may move bodies far, they decrease to the smallest that the factorization resolves,
# which is repeated; where there is no solution they stop at 1e-5, which resolves the residual
_NEAREST = (1e-10, 1e-10, 1e-10)
_DECREASING, _REPEATED = (1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13), 5
_SPARSE, _DENSE, _NO_SOLUTION = 1e-13, 1e-15, 1e-5
# limits on Newton steps, on the bisections of each, and on the corrections of forces
_NEWTON_STEPS, _BISECTIONS, _CORRECTIONS = 60, 60, 20
# rounding of the gradient, relative to the sizes of its terms; relative residuals that are treated
# as zero, and that need no correction
_ROUNDING, _SOLVED, _EXACT = 2.0**-51, 1e-12, 1e-14
# relative singular value treated as zero; relative entry of a combination treated as zero
_UNRESISTED, _TRACE = 1e-13, 1e-14
# largest factor of bounds, its relative accuracy, and ||Cx - d|| / ||d|| of a solution
_LARGEST_FACTOR, _ACCURACY, _BALANCED = 2.0**40, 1e-4, 1e-9


def _half_lines(n: int) -> ProductSet:
    """Return the x >= o."""
    return ProductSet(Bounds.from_below(np.arange(n), np.zeros(n)))


def _is_half_lines(feasible: ProductSet) -> bool:
    """Tell whether some components are at least 0 and the others free."""
    bounds = feasible.bounds
    return not (feasible.curved or bounds.lower.any() or np.isfinite(bounds.upper).any())


def _same(part: Any) -> Any:
    return part


def bounded_springs(
    S: Vector | sp.csr_matrix,
    gap: Vector,
    feasible: ProductSet | None = None,
    *,
    basis: sp.csr_matrix | None = None,
    load: Vector | None = None,
    least_weight: float | None = None,
    sum_vectors: Callable[[Vector], Vector] = _same,
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix] = _same,
) -> Vector:
    """Minimise h(STz - gap) - load'z.

    Parameters
    ----------
    S : (m, n) array or scipy.sparse.csr_matrix
        Closing of each spring by each motion; on several ranks this rank's springs.
    gap : (m,) array
        Gaps at z = o, negative where there is penetration.
    feasible : ProductSet, optional
        The set of forces, which contains o; by default springs only push.
    basis : (n, k) scipy.sparse.csr_matrix, optional
        T: combinations of the motions; by default the motions themselves. Where its columns are
        full, S stays sparse.
    load : (k,) array, optional
        Forces on the motions; the same on all ranks.
    least_weight : float, optional
        Last weight of the distance under a load, relative to the stiffness of the springs: by
        default as small as factors allow.
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
    >>> bounded_springs(S, np.array([-1.0, 3.0, -2.0, -1.0])).round(6).tolist()
    [-1.0, -0.5]
    """
    T = sp.identity(S.shape[1], format="csr") if basis is None else basis
    z = np.zeros(T.shape[1])
    feasible = _half_lines(S.shape[0]) if feasible is None else feasible
    squares = S**2 if isinstance(S, np.ndarray) else S.multiply(S)
    diagonal = sum_vectors(np.asarray(squares.sum(axis=0)).ravel())
    if isinstance(S, np.ndarray):
        # some rows of it are taken in each step
        S = np.ascontiguousarray(S if basis is None else S @ basis)
        T = sp.identity(S.shape[1], format="csr")
    problem = _Problem(
        S,
        T,
        gap,
        feasible,
        np.zeros_like(z) if load is None else load,
        # without springs the distance has a weight all the same
        float(diagonal.max(initial=0.0)) or 1.0,
        sum_vectors,
        sum_matrices,
    )
    if least_weight is None:
        least_weight = _SPARSE if sp.issparse(S) else _DENSE
    return _proximal_points(problem, z, least_weight)


def _proximal_points(problem: _Problem, z: Vector, least_weight: float) -> Vector:
    """Return the last of the points that are nearest with decreasing weights. Collective."""
    size = float(np.linalg.norm(problem.at(z).gradient))
    if size == 0.0:
        return z
    if not problem.load.any():
        for weight in _NEAREST:
            z = _nearest(problem, z, weight * problem.stiffest)
        return z
    decreasing = [weight for weight in _DECREASING if weight > least_weight]
    for weight in (*decreasing, *(_REPEATED * [least_weight])):
        centre, z = z, _nearest(problem, z, weight * problem.stiffest)
        # what the weight leaves of the balance
        left = weight * problem.stiffest * np.linalg.norm(z - centre)
        if left <= _SOLVED * size:
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
    """Derivatives of the cost, see `bounded_springs`."""

    S: Vector | sp.csr_matrix
    T: sp.csr_matrix
    gap: Vector
    feasible: ProductSet
    load: Vector
    stiffest: float
    sum_vectors: Callable[[Vector], Vector]
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix]
    last: list[Any] = field(default_factory=list)  # springs of a dense S that moved, their S'S

    def at(self, z: Vector) -> _Point:
        """Return the gradient at z. Collective."""
        v = self.S @ (self.T @ z) - self.gap
        x = self.feasible.project(v.copy())
        sums = self.sum_vectors(np.append(self.S.T @ x, x @ x))
        gradient = self.T.T @ sums[:-1] - self.load
        terms = np.sqrt(self.stiffest * sums[-1]) + self.stiffest * np.linalg.norm(z)
        return _Point(v, gradient, float(terms + np.linalg.norm(self.load)))

    def step(self, point: _Point, weight: float) -> Vector:
        """Return Newton's step for a gradient with the weight added. Collective."""
        if sp.issparse(self.S):
            H = (self.S.T @ self.feasible.derivative(point.v) @ self.S).tocsr()
            H = self.T.T @ self.sum_matrices(H) @ self.T
            return -np.asarray(_factor(H, weight).solve(point.gradient))
        H = self._normal_matrix(self.feasible.derivative(point.v))
        H[np.diag_indices_from(H)] += weight
        return -np.linalg.solve(H, point.gradient)

    def _normal_matrix(self, D: sp.csr_matrix) -> Vector:
        """Return S'DS of a dense S, by the springs that D is not zero for."""
        moved = np.flatnonzero(np.diff(D.indptr))
        rows = self.S[moved]
        if moved.size < D.nnz or np.any(D.data != 1.0):
            return rows.T @ (D[moved][:, moved] @ rows)
        # the same springs often move in the next step, too
        if not self.last or not np.array_equal(self.last[0], moved):
            # half of the products of a symmetric matrix
            self.last[:] = moved, rows.T @ rows
        return self.last[1].copy()


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


def least_norm(
    C: Vector | sp.csr_matrix,
    d: Vector,
    feasible: ProductSet | None = None,
    *,
    springs: Vector | None = None,
    gap: Vector | None = None,
) -> tuple[Vector, Vector]:
    """Minimise 1/2 ||x||^2 + 1/2 ||p||^2 + gap'x subject to Cx + Ep = d on a convex set of x.

    It is the dual problem of `bounded_springs`: x = P(C'z - gap) and p = E'z. Where columns are
    small, z is large: of an array, rows are combined such that those of (C, E) are orthonormal, and
    what z leaves of the balance is corrected on the components that are not at a bound.

    Parameters
    ----------
    C : (r, n) array or scipy.sparse.csr_matrix
        Few rows, or sparse ones of similar lengths.
    d : (r,) array
        Right-hand side.
    feasible : ProductSet, optional
        The set, which contains o; by default x >= o. With `springs` it leaves these components,
        the last ones, free.
    springs : (r, q) array, optional
        E, if C is an array; its columns may be small.
    gap : (n,) array, optional
        Linear term, zero by default.

    Returns
    -------
    x : (n,) array
        The solution without p; if there is none, x of a minimiser of ||Cx + Ep - d||.
    residual : (r,) array
        d - Cx - Ep; that of the minimiser without the rounding of x if there is no solution, which
        it certifies: its product with d is larger than that with any Cx + Ep.

    Examples
    --------
    A weight of 1 is held against a push of 0.3 by friction of at most 0.2, and by a side wall.

    >>> import numpy as np
    >>> from fenics_tfeti.qp import Bounds, Discs, ProductSet
    >>> C = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0]])
    >>> wall = Bounds.from_below(np.array([0, 1]), np.zeros(2))
    >>> disc = Discs(np.array([[2, 3]]), np.zeros((1, 2)), np.array([0.1]))
    >>> x, residual = least_norm(C, np.array([1.0, 0.3]), ProductSet(wall, disc))
    >>> (x.round(9) + 0.0).tolist(), bool(np.abs(residual).max() < 1e-9)
    ([1.0, 0.2, 0.1, 0.0], True)
    """
    n = C.shape[1]
    feasible = _half_lines(n) if feasible is None else feasible
    A = C if springs is None else np.hstack([C, springs])
    gap = np.zeros(A.shape[1]) if gap is None else np.append(gap, np.zeros(A.shape[1] - n))
    B, b, lengths = _combinations(A, d)
    if not (b.any() and A.shape[1]):
        return np.zeros(n), d.copy()
    rows = (sp.diags(1.0 / lengths) @ B).T
    z = bounded_springs(rows, gap, feasible, load=b / lengths)
    x = _balanced(B, b, feasible, rows @ z - gap)
    residual: Vector = d - A @ x
    if np.linalg.norm(residual) > _SOLVED * np.linalg.norm(d):
        # the smallest residual in the norm of d, for which gaps and sizes of forces do not matter
        units = _units(B, feasible)
        B = B @ sp.diags(units)
        none = np.zeros_like(gap)
        z = bounded_springs(B.T, none, feasible, load=b, least_weight=_NO_SOLUTION)
        tried = units * _balanced(B, b, feasible, B.T @ z)
        if np.linalg.norm(d - A @ tried) < np.linalg.norm(residual):
            x, residual = tried, d - A @ tried
    if np.linalg.norm(residual) > _BALANCED * np.linalg.norm(d):
        residual = _certificate(A, d, feasible, residual)
    return x[:n], residual


def _certificate(A: Any, d: Vector, feasible: ProductSet, residual: Vector) -> Vector:
    """Return the residual, on half-lines the point next to d at which no force does work.

    That is the same but for rounding, which large forces that cancel leave of the balance.
    """
    if not _is_half_lines(feasible):
        return residual
    columns = A @ sp.diags(_units(A, feasible))
    free = columns[:, np.delete(np.arange(A.shape[1]), feasible.bounds.indices)]
    S = sp.hstack([columns, -free]) if sp.issparse(A) else np.hstack([columns, -free])
    point: Vector = d + bounded_springs(S.T, -(S.T @ d))
    certain = np.linalg.norm(point) > _BALANCED * np.linalg.norm(d)
    return point if certain else residual


def _units(B: Any, feasible: ProductSet) -> Vector:
    """Return factors that make columns as long as 1, where the set stays the same with them."""
    if not _is_half_lines(feasible):
        return np.ones(B.shape[1])
    squares = B.multiply(B) if sp.issparse(B) else B**2
    lengths = np.sqrt(np.asarray(squares.sum(axis=0)).ravel())
    return np.divide(1.0, lengths, out=np.ones_like(lengths), where=lengths > 0.0)


def _combinations(A: Any, d: Vector) -> tuple[Any, Vector, Vector]:
    """Return combinations Bx = b of the rows of Ax = d, and lengths to divide them by.

    In a dense B, divided, they are orthonormal: what only small columns resist is separated from
    the rest. A sparse B has the rows of A that do not vanish.
    """
    if sp.issparse(A):
        lengths = np.sqrt(np.asarray(A.multiply(A).sum(axis=1)).ravel())
        kept = lengths > 0.0
        return (A, d, lengths) if kept.all() else (A.tocsr()[kept], d[kept], lengths[kept])
    # the factor has as few columns as rows
    R = np.asarray(np.linalg.qr(A.T, mode="r"))
    U, lengths, _ = np.linalg.svd(R.T, full_matrices=False)
    kept = lengths > _UNRESISTED * lengths.max(initial=0.0)
    B, b = U[:, kept].T @ A, U[:, kept].T @ d
    B[np.abs(B) <= _TRACE * np.abs(B).max(axis=0, initial=0.0)] = 0.0
    return B, b, lengths[kept]


def _balanced(B: Any, b: Vector, feasible: ProductSet, v: Vector) -> Vector:
    """Return P(v), or a point near it with a smaller residual b - Bx."""
    best = x = feasible.project(v.copy())
    least = float(np.linalg.norm(b - B @ x))
    for _ in range(_CORRECTIONS):
        if least <= _EXACT * np.linalg.norm(b):
            break
        v = x + _correction(B, b - B @ x, feasible, v)
        x = feasible.project(v.copy())
        left = float(np.linalg.norm(b - B @ x))
        if left < least:
            best, least = x, left
    return best


def _correction(B: Any, missing: Vector, feasible: ProductSet, v: Vector) -> Vector:
    """Return D y, D = P'(v), for the smallest y with B D y = missing in the least squares sense."""
    D = feasible.derivative(v)
    if sp.issparse(B):
        BD = (B @ D).tocsr()
        H = BD @ BD.T
        weight = _SPARSE * float(H.diagonal().max(initial=0.0))
        return D @ (BD.T @ _factor(H, weight or 1.0).solve(missing))
    return D @ np.linalg.lstsq((D @ B.T).T, missing, rcond=None)[0]


def _factor(H: Any, weight: float) -> Any:
    """Return the sparse factors of H + weight I."""
    shifted = (H + weight * sp.identity(H.shape[0])).tocsc()
    symmetric = {"SymmetricMode": True}
    return splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)


def smallest_factor(C: Vector | sp.csr_matrix, d: Vector, feasible: ProductSet) -> float:
    """Return the smallest factor of radii, intervals and slopes with which Cx = d has a solution.

    Parameters
    ----------
    C, d, feasible
        As in `least_norm`; intervals contain 0 inside, half-lines begin there.

    Returns
    -------
    float
        To a relative accuracy of 1e-4, from above; infinite if there is none.

    Examples
    --------
    >>> import numpy as np
    >>> from fenics_tfeti.qp import Discs, ProductSet
    >>> disc = Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.array([0.5]))
    >>> round(smallest_factor(np.identity(2), np.array([0.6, 0.8]), ProductSet(discs=disc)), 3)
    2.0
    """

    def solvable(factor: float) -> bool:
        residual = least_norm(C, d, feasible.scaled(factor))[1]
        return bool(np.linalg.norm(residual) <= _BALANCED * np.linalg.norm(d))

    lower, upper = 0.0, 1.0
    while not solvable(upper):
        # 2, 4, 16, 256, ...
        lower, upper = upper, max(2.0, upper**2)
        if upper > _LARGEST_FACTOR:
            return np.inf
    while upper - lower > _ACCURACY * upper:
        middle = np.sqrt(lower * upper) if lower else 0.5 * upper
        lower, upper = (lower, middle) if solvable(middle) else (middle, upper)
    return float(upper)
