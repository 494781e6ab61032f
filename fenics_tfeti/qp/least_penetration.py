"""The motion with the least penetration: the smallest sum of squares of violated inequalities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fenics_tfeti.typing import Mask, Vector

# weights of the distance beside the penetration, relative to the fastest closing: they make the
# problem definite, and what they leave of the penetration is removed by further proximal steps
_LAST_WEIGHTS = (1e-10, 1e-10, 1e-10)
# the same under a load that only rows balance: these may be far
_FIRST_WEIGHTS = (1e-1, 1e-3, 1e-5, 1e-7)
_NEWTON_STEPS = 40
# sufficient decrease, and the shortest step
_DECREASE, _SHORTEST = 1e-4, 1e-9
# change of the cost that is rounding, and one that rounding of rows that touch makes
_ROUNDING, _NO_DECREASE = 1e-13, 1e-24


def _same(part: Any) -> Any:
    return part


def least_penetration(
    S: sp.csr_matrix,
    gap: Vector,
    sum_vectors: Callable[[Vector], Vector] = _same,
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix] = _same,
    *,
    basis: sp.csr_matrix | None = None,
    load: Vector | None = None,
    stiffness: sp.csr_matrix | None = None,
) -> Vector:
    """Minimise 1/2 ||max(STz - gap, o)||^2 + 1/2 z'Kz - load'z.

    The proximal semismooth Newton method; of several minimisers one near z = o is found.

    Parameters
    ----------
    S : (m, n) scipy.sparse.csr_matrix
        Closing of each row by each motion; on several ranks this rank's rows.
    gap : (m,) array
        Gaps at z = o, negative where there is penetration.
    sum_vectors, sum_matrices : callable
        Sums over the ranks of arrays and of sparse matrices (n, n).
    basis : (n, k) scipy.sparse.csr_matrix, optional
        T: combinations of the motions; by default the motions themselves. Where its columns are
        full, S stays sparse.
    load : (k,) array, optional
        Forces on the motions: the rows are springs of stiffness 1 then. K can balance them or, if
        there is none, the rows. The same on all ranks.
    stiffness : (k, k) scipy.sparse.csr_matrix, optional
        K, positive semidefinite; the same on all ranks.

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
    T = sp.identity(S.shape[1], format="csr") if basis is None else basis
    z = np.zeros(T.shape[1])
    K = sp.csr_matrix((z.size, z.size)) if stiffness is None else stiffness
    load = np.zeros_like(z) if load is None else load
    first = sum_vectors(np.append(S.T @ np.maximum(-gap, 0.0), S.multiply(S).sum(axis=0)))
    forces, squares = np.split(first, 2)
    if not (T.T @ forces - load).any():
        return z
    energy = _Energy(S, T, gap, K, load, sum_vectors, sum_matrices)
    largest = float(np.append(squares, K.diagonal()).max(initial=0.0))
    far = stiffness is None and load.any()
    for weight in (*(_FIRST_WEIGHTS if far else ()), *_LAST_WEIGHTS):
        z = _nearest(energy, z, weight * largest)
    return z


@dataclass(frozen=True)
class _Energy:
    """What is minimised; see `least_penetration`."""

    S: sp.csr_matrix
    T: sp.csr_matrix
    gap: Vector
    K: sp.csr_matrix
    load: Vector
    sum_vectors: Callable[[Vector], Vector]
    sum_matrices: Callable[[sp.csr_matrix], sp.csr_matrix]

    def at(self, z: Vector) -> tuple[float, Vector, Mask]:
        """Return the energy, its gradient, and the rows that are penetrated."""
        y = np.maximum(self.S @ (self.T @ z) - self.gap, 0.0)
        sums = self.sum_vectors(np.append(self.S.T @ y, 0.5 * (y @ y)))
        resisted = self.K @ z
        energy = float(sums[-1]) + 0.5 * float(z @ resisted) - float(self.load @ z)
        return energy, self.T.T @ sums[:-1] + resisted - self.load, y > 0.0

    def hessian(self, penetrated: Mask) -> sp.csr_matrix:
        """Return the second derivative while the penetrated rows stay the same."""
        rows = self.S[np.flatnonzero(penetrated)]
        return self.T.T @ self.sum_matrices((rows.T @ rows).tocsr()) @ self.T + self.K


def _nearest(energy: _Energy, start: Vector, weight: float) -> Vector:
    """Minimise the energy + weight/2 ||z - start||^2."""

    def at(z: Vector) -> tuple[float, Vector, Mask]:
        value, gradient, penetrated = energy.at(z)
        away = z - start
        return value + 0.5 * weight * float(away @ away), gradient + weight * away, penetrated

    z = start
    value, gradient, penetrated = at(z)
    for _ in range(_NEWTON_STEPS):
        H = (energy.hessian(penetrated) + weight * sp.identity(z.size)).tocsc()
        symmetric = {"SymmetricMode": True}
        factor = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        step = -factor.solve(gradient)
        slope, length = float(gradient @ step), 1.0
        # rows that rounding closes and opens
        if -slope <= _NO_DECREASE * abs(value):
            break
        # near the solution the decrease drowns in rounding
        limit = value + _ROUNDING * abs(value)
        while True:
            tried, following, new = at(z + length * step)
            if tried <= limit + _DECREASE * length * slope or length <= _SHORTEST:
                break
            length *= 0.5
        z, value, gradient = z + length * step, tried, following
        changed, penetrated = np.count_nonzero(new != penetrated), new
        if length == 1.0 and not energy.sum_vectors(np.array([float(changed)])).any():
            break
    return z
