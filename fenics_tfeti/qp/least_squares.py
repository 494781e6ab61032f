"""Least squares problems with signs: rigid motions against contact conditions.

They are small and dense, but for `least_norm_nonnegative`, which takes many sparse rows as well.

After Lawson and Hanson, Solving Least Squares Problems, chapter 23. Rows and columns may be of any
length, also zero.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from fenics_tfeti.typing import Vector

# cosine of the angle between a column and the residual that counts as a right angle
_ORTHOGONAL = 1e-12
# ||b - Ax|| / ||b|| that counts as zero
_ROUNDING = 1e-15
# ||d - Cx|| / ||d|| with which Newton's method ends
_NEWTON = 1e-11
# 1 / sqrt(1 + z'z), z in units of the largest violation, below which no z fulfils the conditions
_NO_SOLUTION = 1e-12
# length of a combination of rows, relative to the longest, that is rounding, and what rounding
# leaves of a column in it
_UNRESISTED_ROW = 1e-13
_TRACE = 1e-14


def nonnegative_least_squares(A: Vector, b: Vector) -> Vector:
    """Minimise ||Ax - b|| subject to x >= o.

    Parameters
    ----------
    A : (r, n) array
        Columns of any length; those of length zero get x = 0.
    b : (r,) array
        Right-hand side.

    Returns
    -------
    (n,) array
        A basic solution.

    Examples
    --------
    >>> import numpy as np
    >>> nonnegative_least_squares(np.array([[1e-9, 0.0, -1.0]]), np.array([2e-9])).round(9).tolist()
    [2.0, 0.0, 0.0]
    """
    x = np.zeros(A.shape[1])
    lengths, size = _lengths(A.T), float(_lengths(b[None])[0])
    there = np.flatnonzero(lengths)
    if there.size == 0 or size == 0.0:
        return x
    x[there] = size * _lawson_hanson(A[:, there] / lengths[there], b / size) / lengths[there]
    return x


def _lawson_hanson(A: Vector, b: Vector) -> Vector:
    """Minimise ||Ax - b|| subject to x >= o, for columns and b of unit length (23.10)."""
    x, passive = np.zeros(A.shape[1]), np.zeros(0, dtype=np.int64)
    residual, barred = b, np.zeros(A.shape[1], dtype=bool)
    for _ in range(10 * sum(A.shape)):
        size = float(np.linalg.norm(residual))
        descent = np.where(barred, 0.0, A.T @ residual)
        descent[passive] = 0.0
        new = int(np.argmax(descent))
        # a column that is orthogonal to the residual but for rounding is no help
        if size <= _ROUNDING or descent[new] <= _ORTHOGONAL * size:
            break
        tried, columns = _feasible_step(A, b, x, np.append(passive, new))
        left = b - A @ tried
        if np.linalg.norm(left) < size:
            x, passive, residual = tried, columns, left
            barred[:] = False
        else:
            # by rounding; another column may help
            barred[new] = True
    return x


def _feasible_step(
    A: Vector, b: Vector, x: Vector, passive: NDArray[np.int64]
) -> tuple[Vector, NDArray[np.int64]]:
    """Go from x >= o towards the minimiser over some columns; those that reach zero leave."""
    x = x.copy()
    while passive.size:
        step = np.linalg.lstsq(A[:, passive], b, rcond=None)[0]
        falling = step <= 0.0
        if not falling.any():
            x[passive] = step
            break
        fall = (x[passive] - step)[falling]
        way = np.divide(x[passive][falling], fall, out=np.zeros(fall.size), where=fall > 0.0)
        x[passive] += way.min() * (step - x[passive])
        leaving = passive[falling][way <= way.min()]
        x[leaving] = 0.0
        passive = passive[~np.isin(passive, leaving)]
    return x, passive


def _lengths(rows: Vector) -> Vector:
    """Return the norms of rows without underflow."""
    largest = np.abs(rows).max(axis=1, initial=0.0)
    safe = np.where(largest > 0.0, largest, 1.0)
    lengths: Vector = largest * np.linalg.norm(rows / safe[:, None], axis=1)
    return lengths


def least_norm_nonnegative(C: Vector | sp.csc_matrix, d: Vector) -> tuple[Vector, Vector]:
    """Minimise 1/2 ||x||^2 subject to Cx = d and x >= o, by a semismooth Newton method on the dual.

    Parameters
    ----------
    C : (r, n) array or scipy.sparse.csc_matrix
        Few rows, or sparse ones.
    d : (r,) array
        Right-hand side.

    Returns
    -------
    x : (n,) array
        The solution; if there is none, a minimiser of ||Cx - d||.
    residual : (r,) array
        d - Cx. Where it is not zero it certifies that there is no solution: C'residual <= o and
        d'residual > 0.

    Examples
    --------
    >>> import numpy as np
    >>> x, residual = least_norm_nonnegative(np.array([[1.0, 1.0, -1.0]]), np.array([2.0]))
    >>> x.round(12).tolist(), residual.round(12).tolist()
    ([1.0, 1.0, 0.0], [0.0])
    """
    entries = np.asarray(C.data if sp.issparse(C) else C)
    size, stiffness = (float(_lengths(x.reshape(1, -1))[0]) for x in (d, entries))
    if size == 0.0 or stiffness == 0.0:
        return np.zeros(C.shape[1]), d.copy()
    unit, target = C / stiffness, d / size
    found = _newton(unit, target)
    if found is None:
        # no solution, or one that rounding hides: the basic solution decides, with a certificate
        dense = sp.csc_matrix(unit).toarray()
        found = nonnegative_least_squares(dense, target)
    return found * (size / stiffness), size * (target - unit @ found)


def _newton(C: Vector | sp.csc_matrix, d: Vector) -> Vector | None:
    """Return x = max(C'y, o) with Cx = d, for C and d of unit length; None if none is found."""
    y = np.zeros(d.size)

    def value(y: Vector) -> float:
        return 0.5 * float(np.sum(np.maximum(C.T @ y, 0.0) ** 2)) - float(d @ y)

    for step in range(100):
        x = np.maximum(C.T @ y, 0.0)
        gradient = C @ x - d
        size = float(np.linalg.norm(gradient))
        if not np.isfinite(size):
            return None
        if size <= _NEWTON:
            return x
        support = C[:, x > 0.0] if step else C
        # damped where the support leaves the Hessian singular; fades as the gradient does
        damping = min(1e-3, size) / d.size
        p = -_damped_inverse(support, damping, gradient)
        slope, length = float(gradient @ p), 1.0
        # near the solution the decrease drowns in rounding
        limit = value(y) + 1e-12 * abs(value(y))
        while value(y + length * p) > limit + 1e-4 * length * slope and length > 1e-12:
            length *= 0.5
        y = y + length * p
    return None


def _damped_inverse(C: Vector | sp.csc_matrix, damping: float, b: Vector) -> Vector:
    """Return (CC' + damping I)^{-1} b."""
    if sp.issparse(C):
        H = (C @ C.T + damping * sp.identity(b.size)).tocsc()
        symmetric = {"SymmetricMode": True}
        factor = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        x: Vector = factor.solve(b)
        return x
    x = np.linalg.solve(C @ C.T + damping * np.eye(b.size), b)
    return x


def least_norm_partly_nonnegative(
    C: Vector, E: Vector, d: Vector, g: Vector
) -> tuple[Vector, Vector]:
    """Minimise 1/2 ||x||^2 + 1/2 ||p||^2 + g'x subject to Cx + Ep = d and x >= o, where E is small.

    As `least_norm_nonnegative`, but with the columns of E free of signs. Where they are small the
    dual variables are as large as 1 / ||E||^2. So the rows are combined such that those of (C, E)
    are orthonormal: what only E resists is separated from what C resists.

    Parameters
    ----------
    C : (r, n) array
        Few rows.
    E : (r, q) array
        Columns of any size.
    d : (r,) array
        Right-hand side.
    g : (n,) array
        Linear term.

    Returns
    -------
    x : (n,) array
        The solution without p; if there is none, x of a minimiser of ||Cx + Ep - d||.
    residual : (r,) array
        d - Cx - Ep.

    Examples
    --------
    >>> import numpy as np
    >>> C, E = np.array([[1.0], [-1.0]]), 1e-6 * np.identity(2)
    >>> x, residual = least_norm_partly_nonnegative(C, E, np.array([2.0, 1.0]), np.zeros(1))
    >>> x.round(6).tolist(), bool(np.abs(residual).max() < 1e-9)
    ([0.5], True)
    """
    whole = np.hstack([C, E])
    if not d.any():
        return np.zeros(C.shape[1]), d.copy()
    U, lengths, _ = np.linalg.svd(whole, full_matrices=False)
    kept = lengths > _UNRESISTED_ROW * lengths.max(initial=0.0)
    U, lengths = U[:, kept], lengths[kept]
    columns = U.T @ whole
    columns[np.abs(columns) <= _TRACE * np.abs(columns).max(axis=0, initial=0.0)] = 0.0
    columns /= lengths[:, None]
    n, sums = C.shape[1], U.T @ d
    x, p = _newton_partly(columns[:, :n], columns[:, n:], sums / lengths, g)
    found = _balanced(lengths[:, None] * columns, np.append(x, p), n, sums)
    if found is None:
        # no solution, or one that rounding hides: the basic solution decides
        signed = nonnegative_least_squares(np.hstack([columns, -columns[:, n:]]), sums / lengths)
        found = np.append(signed[:n], signed[n : whole.shape[1]] - signed[whole.shape[1] :])
    return found[:n], d - whole @ found


def _balanced(A: Vector, x: Vector, n: int, d: Vector) -> Vector | None:
    """Return the nearest x with Ax = d, the first n components nonnegative and zero where they are.

    None if there is none near.
    """
    bounded = np.arange(x.size) < n
    if not np.isfinite(x).all():
        return None
    while True:
        missing, free = d - A @ x, (x > 0.0) | ~bounded
        size = float(np.linalg.norm(missing))
        if size <= _NEWTON * np.linalg.norm(d):
            return x
        x = x.copy()
        x[free] += np.linalg.lstsq(A[:, free], missing, rcond=None)[0]
        negative = bounded & (x < 0.0)
        x[negative] = 0.0
        if not negative.any():
            return x if np.linalg.norm(d - A @ x) <= _NEWTON * np.linalg.norm(d) else None


def _newton_partly(C: Vector, E: Vector, d: Vector, g: Vector) -> tuple[Vector, Vector]:
    """Return x = max(C'y - g, o) and p = E'y with Cx + Ep = d but for rounding.

    The rows of (C, E) are orthonormal. Without a solution, x and p of the last step.
    """
    # damped where E does not resist
    left, resisted, _ = np.linalg.svd(E)
    free_rows = left[:, np.count_nonzero(resisted > _UNRESISTED_ROW) :].T
    y, scale = np.zeros(d.size), float(np.linalg.norm(d))

    def value(y: Vector) -> float:
        free = E.T @ y
        pressed = np.maximum(C.T @ y - g, 0.0)
        return float(0.5 * (pressed @ pressed + free @ free) - d @ y)

    for step in range(100):
        x, p = np.maximum(C.T @ y - g, 0.0), E.T @ y
        gradient = C @ x + E @ p - d
        size = float(np.linalg.norm(gradient))
        if size <= _NEWTON * scale or not np.isfinite(size):
            break
        support = C[:, x > 0.0] if step else C
        damping = np.sqrt(min(1e-3, size / scale) / d.size)
        # QR of the factors of the Hessian keeps the accuracy that their product would lose
        R = np.linalg.qr(np.vstack([support.T, E.T, damping * free_rows]), mode="r")
        direction = -solve_triangular(R, solve_triangular(R, gradient, trans="T"))
        slope, length = float(gradient @ direction), 1.0
        limit = value(y) + 1e-12 * abs(value(y))
        while value(y + length * direction) > limit + 1e-4 * length * slope and length > 1e-12:
            length *= 0.5
        y = y + length * direction
    return x, p


def least_distance(A: Vector, b: Vector) -> Vector:
    """Minimise ||z|| subject to Az <= b (Lawson and Hanson, 23.4).

    Parameters
    ----------
    A : (m, k) array
        Rows of any length; a row of length zero is the condition 0 <= b.
    b : (m,) array
        Right-hand sides.

    Returns
    -------
    (k,) array
        The solution; zeros if no z fulfils the conditions.

    Examples
    --------
    >>> import numpy as np
    >>> z = least_distance(np.array([[-1.0, 0.0], [0.0, -2.0]]), np.array([-1.0, 4.0]))
    >>> (z.round(12) + 0.0).tolist()
    [1.0, 0.0]
    """
    none = np.zeros(A.shape[1])
    lengths = _lengths(A)
    if np.any((lengths == 0.0) & (b < 0.0)):
        return none
    there = lengths > 0.0
    A, b = A[there] / lengths[there, None], b[there] / lengths[there]
    # the largest violation at z = o: conditions that are far from it do not set the scale
    scale = float((-b).max(initial=0.0))
    if scale == 0.0:
        return none
    rows = np.vstack([A.T, b / scale])
    target = np.append(none, 1.0)
    weights = nonnegative_least_squares(-rows, target)
    if np.linalg.norm(rows @ weights + target) <= _NO_SOLUTION:
        return none
    # the conditions that hold with equality say the same with less cancellation
    active = weights > 0.0
    z: Vector = np.linalg.lstsq(A[active], b[active], rcond=None)[0]
    return z
