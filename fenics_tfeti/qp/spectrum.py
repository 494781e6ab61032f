"""Estimate of the largest eigenvalue by the Lanczos method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import eigh_tridiagonal

from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Vector


def lanczos_estimate(
    operator: Callable[[Vector], Vector], start: Vector, steps: int, space: Space | None = None
) -> float:
    """Estimate the largest eigenvalue of a symmetric positive semidefinite operator from above.

    The largest Ritz value is a lower bound. Within the norm of its residual there is an eigenvalue,
    but after few steps not necessarily the largest one: their sum is an estimate, usually from
    above.

    Parameters
    ----------
    operator : callable
        x -> Ax.
    start : (n,) array
        Start vector, for instance random.
    steps : int
        Number of products, at least 1.
    space : Space, optional
        The inner product.

    Returns
    -------
    float
        Largest Ritz value plus the norm of its residual.

    Examples
    --------
    >>> import numpy as np
    >>> bound = lanczos_estimate(lambda x: np.arange(1.0, 5.0) * x, np.ones(4), 4)
    >>> round(bound, 8)
    4.0
    """
    space = space or Space()
    norm = space.norm(start)
    if norm == 0.0:
        return 0.0
    v, v_previous = start / norm, np.zeros_like(start)
    diagonal: list[float] = []
    off_diagonal: list[float] = []
    residual = 0.0
    for _ in range(steps):
        w = operator(v) - residual * v_previous
        diagonal.append(space.dots((w, v))[0])
        w -= diagonal[-1] * v
        residual = space.norm(w)
        if residual <= 1e-14 * max(map(abs, diagonal)):
            residual = 0.0
            break
        off_diagonal.append(residual)
        v_previous, v = v, w / residual
    k = len(diagonal)
    values, vectors = eigh_tridiagonal(np.array(diagonal), np.array(off_diagonal[: k - 1]))
    return float(values[-1] + residual * abs(vectors[-1, -1]))
