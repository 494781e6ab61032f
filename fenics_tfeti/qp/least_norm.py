"""The smallest point of a product of half-lines, intervals and discs with Cx = d, of few rows.

With friction: the smallest contact forces that balance a load, or the part of it that no forces
within their bounds can balance.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from fenics_tfeti.qp.feasible_set import ProductSet
from fenics_tfeti.typing import Vector

# decreasing regularisation, relative to ||C||^2, and steps of Newton's method for each
_REGULARISATION = 10.0 ** -np.arange(1.0, 14.0)
_NEWTON_STEPS = 60
# limit on the bisections of a step
_BISECTIONS = 60
# ||Cx - d|| / ||d|| with which the iterations end, and of a solution
_NEWTON = 1e-12
_SOLVED = 1e-9
# largest factor of the radii, and relative accuracy of the smallest one
_LARGEST_FACTOR = 2.0**40
_ACCURACY = 1e-4


def least_norm_in_set(
    C: Vector | sp.csr_matrix, d: Vector, feasible: ProductSet
) -> tuple[Vector, Vector]:
    """Minimise 1/2 ||x||^2 subject to Cx = d on a convex set that contains o.

    The dual problem, maximise d'y - h(C'y) with h(v) = v'P(v) - 1/2 ||P(v)||^2 and the projection P
    onto the set, is solved by the proximal point method: each step regularises it by
    delta/2 ||y - y_0||^2 with the last y_0, and delta tends to zero. The semismooth Newton method
    solves it. Then x = P(C'y) and Cx + delta (y - y_0) = d: without a solution delta (y - y_0)
    tends to the smallest residual.

    Parameters
    ----------
    C : (r, n) array or scipy.sparse.csr_matrix
        Few rows, or a sparse matrix of many.
    d : (r,) array
        Right-hand side.
    feasible : ProductSet
        The set.

    Returns
    -------
    x : (n,) array
        The solution; if there is none, a minimiser of ||Cx - d||.
    residual : (r,) array
        d - Cx.

    Examples
    --------
    A weight of 1 is held against a push of 0.3 by friction of at most 0.2, and by a side wall.

    >>> import numpy as np
    >>> from fenics_tfeti.qp import Bounds, Discs, ProductSet
    >>> C = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0]])
    >>> wall = Bounds.from_below(np.array([0, 1]), np.zeros(2))
    >>> disc = Discs(np.array([[2, 3]]), np.zeros((1, 2)), np.array([0.1]))
    >>> x, residual = least_norm_in_set(C, np.array([1.0, 0.3]), ProductSet(wall, disc))
    >>> (x.round(9) + 0.0).tolist(), bool(np.abs(residual).max() < 1e-9)
    ([1.0, 0.2, 0.1, 0.0], True)
    """
    size = float(np.linalg.norm(d))
    # the longest of many rows: their sum would regularise too much
    rows = C.multiply(C).sum(axis=1) if isinstance(C, sp.csr_matrix) else np.sum(C**2)
    stiffness = float(np.max(np.append(np.asarray(rows).ravel(), 0.0)))
    y = np.zeros(d.size)
    if size == 0.0 or stiffness == 0.0:
        return np.zeros(C.shape[1]), d.copy()
    for delta in stiffness * _REGULARISATION:
        y = _newton(C, d, feasible, y, delta, _NEWTON * size)
        x = feasible.project(C.T @ y)
        residual = d - C @ x
        if np.linalg.norm(residual) <= _NEWTON * size:
            break
    return x, residual


def smallest_factor(C: Vector | sp.csr_matrix, d: Vector, feasible: ProductSet) -> float:
    """Return the smallest factor of radii, intervals and slopes with which Cx = d has a solution.

    Parameters
    ----------
    C, d, feasible
        As in `least_norm_in_set`; intervals contain 0 inside, half-lines begin there.

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
        residual = least_norm_in_set(C, d, feasible.scaled(factor))[1]
        return bool(np.linalg.norm(residual) <= _SOLVED * np.linalg.norm(d))

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


def _newton(
    C: Vector | sp.csr_matrix,
    d: Vector,
    feasible: ProductSet,
    centre: Vector,
    delta: float,
    tolerance: float,
) -> Vector:
    """Maximise d'y - h(C'y) - delta/2 ||y - centre||^2 by the semismooth Newton method."""

    def gradient(y: Vector) -> Vector:
        x: Vector = C @ feasible.project(C.T @ y) + delta * (y - centre) - d
        return x

    y = centre
    for _ in range(_NEWTON_STEPS):
        g = gradient(y)
        if np.linalg.norm(g) <= tolerance:
            break
        p = _newton_step(C, feasible, C.T @ y, delta, -g)
        y = y + _step_length(gradient, y, p) * p
    return y


def _step_length(gradient: Callable[[Vector], Vector], y: Vector, p: Vector) -> float:
    """Return 1, or a step along p after which a convex function is at most half as steep.

    Slopes tell on which side of a kink the minimum is where differences of the function are
    rounding.
    """
    lower, upper, length = 0.0, 1.0, 1.0
    limit, ahead = 0.5 * abs(float(gradient(y) @ p)), float(gradient(y + p) @ p)
    if ahead <= limit:
        return length
    for _ in range(_BISECTIONS):
        length = 0.5 * (lower + upper)
        ahead = float(gradient(y + length * p) @ p)
        if abs(ahead) <= limit:
            break
        lower, upper = (lower, length) if ahead > 0.0 else (length, upper)
    return length


def _newton_step(
    C: Vector | sp.csr_matrix,
    feasible: ProductSet,
    v: Vector,
    delta: float,
    b: Vector,
) -> Vector:
    """Solve (C P'(v) C' + delta) p = b."""
    if sp.issparse(C):
        H = (C @ feasible.derivative(v) @ C.T + delta * sp.identity(b.size)).tocsc()
        step: Vector = spl.splu(H).solve(b)
        return step
    return np.linalg.solve(C @ (feasible.derivative(v) @ C.T) + delta * np.eye(b.size), b)
