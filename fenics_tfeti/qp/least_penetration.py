"""The motion with the least penetration: the smallest sum of squares of violated inequalities."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

__all__ = ["least_penetration"]

Vector = NDArray[np.float64]

# weights of the distance beside the penetration, relative to the fastest closing: they make the
# problem definite, and what they leave of the penetration is removed by further proximal steps
_LAST_WEIGHTS = (1e-10, 1e-10, 1e-10)
# the same under a load, from which bodies start far
_FIRST_WEIGHTS = (1e-1, 1e-3, 1e-5, 1e-7)
_NEWTON_STEPS = 40
# sufficient decrease, and the shortest step
_DECREASE, _SHORTEST = 1e-4, 1e-9
# change of the cost that is rounding
_ROUNDING = 1e-13


def _same(part: Any) -> Any:
    return part


def least_penetration(
    S: sp.csr_matrix,
    gap: Vector,
    sum_vectors: Callable[[Vector], Vector] = _same,
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix] = _same,
    load: Vector | None = None,
) -> Vector:
    """Minimise 1/2 ||max(Sz - gap, o)||^2 - load'z by the proximal semismooth Newton method.

    Of several minimisers one near z = o is found.

    Parameters
    ----------
    S : (m, k) scipy.sparse.csr_matrix
        Closing of each row by each motion; on several ranks this rank's rows.
    gap : (m,) array
        Gaps at z = o, negative where there is penetration.
    sum_vectors, sum_matrices : callable
        Sums over the ranks of arrays (n,) and of sparse matrices (k, k).
    load : (k,) array, optional
        Forces on the motions, which rows can balance: the rows are springs of stiffness 1 then.

    Returns
    -------
    (k,) array
        z, the same on all ranks.

    Examples
    --------
    A body between two walls, one of which it penetrates, and another one that is squeezed.

    >>> import numpy as np, scipy.sparse as sp
    >>> S = sp.csr_matrix([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    >>> least_penetration(S, np.array([-1.0, 3.0, -2.0, -1.0])).round(6).tolist()
    [-1.0, -0.5]
    """
    z = np.zeros(S.shape[1])
    load = np.zeros_like(z) if load is None else load
    first = sum_vectors(np.append(S.T @ np.maximum(-gap, 0.0), S.multiply(S).sum(axis=0)))
    gradient, squares = first[: z.size] - load, first[z.size :]
    if not gradient.any():
        return z
    for weight in (*(_FIRST_WEIGHTS if load.any() else ()), *_LAST_WEIGHTS):
        distance = weight * float(squares.max(initial=0.0))
        z = _nearest(S, gap, load, z, distance, sum_vectors, sum_matrices)
    return z


def _nearest(
    S: sp.csr_matrix,
    gap: Vector,
    load: Vector,
    start: Vector,
    weight: float,
    sum_vectors: Callable[[Vector], Vector],
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix],
) -> Vector:
    """Minimise 1/2 ||max(Sz - gap, o)||^2 - load'z + weight/2 ||z - start||^2."""

    def cost_and_gradient(z: Vector) -> tuple[float, Vector, Vector]:
        y = np.maximum(S @ z - gap, 0.0)
        sums = sum_vectors(np.append(S.T @ y, 0.5 * (y @ y)))
        away = z - start
        cost = float(sums[-1]) - float(load @ z) + 0.5 * weight * float(away @ away)
        return cost, sums[:-1] - load + weight * away, y > 0.0

    z = start
    cost, gradient, penetrated = cost_and_gradient(z)
    for _ in range(_NEWTON_STEPS):
        rows = S[np.flatnonzero(penetrated)]
        H = (sum_matrices((rows.T @ rows).tocsr()) + weight * sp.identity(z.size)).tocsc()
        symmetric = {"SymmetricMode": True}
        factor = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        step = -factor.solve(gradient)
        slope, length = float(gradient @ step), 1.0
        # near the solution the decrease drowns in rounding
        limit = cost + _ROUNDING * abs(cost)
        while True:
            tried, following, new = cost_and_gradient(z + length * step)
            if tried <= limit + _DECREASE * length * slope or length <= _SHORTEST:
                break
            length *= 0.5
        z, cost, gradient = z + length * step, tried, following
        changed, penetrated = np.count_nonzero(new != penetrated), new
        if length == 1.0 and not sum_vectors(np.array([float(changed)])).any():
            break
    return z
