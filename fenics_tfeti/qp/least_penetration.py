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

# distance that counts beside the penetration, relative to the fastest closing: it makes the problem
# definite, and what it leaves of the penetration is removed by the proximal steps
_DISTANCE = 1e-10
_PROXIMAL_STEPS = 3
_NEWTON_STEPS = 40
# sufficient decrease, and the shortest step
_DECREASE, _SHORTEST = 1e-4, 1e-9


def _same(part: Any) -> Any:
    return part


def least_penetration(
    S: sp.csr_matrix,
    gap: Vector,
    sum_vectors: Callable[[Vector], Vector] = _same,
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix] = _same,
) -> Vector:
    """Minimise 1/2 ||max(Sz - gap, o)||^2, by the semismooth Newton method with proximal steps.

    Of several minimisers one near z = o is found.

    Parameters
    ----------
    S : (m, k) scipy.sparse.csr_matrix
        Closing of each row by each motion; on several ranks this rank's rows.
    gap : (m,) array
        Gaps at z = o, negative where there is penetration.
    sum_vectors, sum_matrices : callable
        Sums over the ranks of arrays (n,) and of sparse matrices (k, k).

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
    first = sum_vectors(np.append(S.T @ np.maximum(-gap, 0.0), S.multiply(S).sum(axis=0)))
    gradient, squares = first[: z.size], first[z.size :]
    weight = _DISTANCE * float(squares.max(initial=0.0))
    if not gradient.any():
        return z
    for _ in range(_PROXIMAL_STEPS):
        z = _nearest(S, gap, z, weight, sum_vectors, sum_matrices)
    return z


def _nearest(
    S: sp.csr_matrix,
    gap: Vector,
    start: Vector,
    weight: float,
    sum_vectors: Callable[[Vector], Vector],
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix],
) -> Vector:
    """Minimise 1/2 ||max(Sz - gap, o)||^2 + weight/2 ||z - start||^2."""

    def cost_and_gradient(z: Vector) -> tuple[float, Vector, Vector]:
        y = np.maximum(S @ z - gap, 0.0)
        sums = sum_vectors(np.append(S.T @ y, 0.5 * (y @ y)))
        away = z - start
        cost = float(sums[-1]) + 0.5 * weight * float(away @ away)
        return cost, sums[:-1] + weight * away, y > 0.0

    z = start
    cost, gradient, penetrated = cost_and_gradient(z)
    for _ in range(_NEWTON_STEPS):
        rows = S[np.flatnonzero(penetrated)]
        H = (sum_matrices((rows.T @ rows).tocsr()) + weight * sp.identity(z.size)).tocsc()
        symmetric = {"SymmetricMode": True}
        factor = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        step = -factor.solve(gradient)
        slope, length = float(gradient @ step), 1.0
        while True:
            tried, following, new = cost_and_gradient(z + length * step)
            if tried <= cost + _DECREASE * length * slope or length <= _SHORTEST:
                break
            length *= 0.5
        if tried >= cost:
            break
        z, cost, gradient = z + length * step, tried, following
        changed, penetrated = np.count_nonzero(new != penetrated), new
        if length == 1.0 and not sum_vectors(np.array([float(changed)])).any():
            break
    return z
