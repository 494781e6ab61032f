"""Flexible GMRES, preconditioned from the right, for M + E with solutions of M z = v.

z_0 = M^-1 b,  v_0 = b - (M + E) z_0 = -E z_0
z_j = M^-1 v_j,  (M + E) z_j = v_j + E z_j,  z = z_0 + sum_j y_j z_j

so that products with M are not needed, and z may have any type. Saad, SIAM J. Sci. Comput. 14
(1993) 461-469.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Vector

Z = TypeVar("Z")


def flexible_gmres(
    residual: Vector,
    solve: Callable[[Vector], Z],
    rest: Callable[[Z], Vector],
    space: Space,
    *,
    tolerance: float,
    most: int,
) -> tuple[list[Z], Vector, float]:
    """Return solutions z_j, their coefficients y_j, and the norm of the residual that is left.

    Parameters
    ----------
    residual : (n,) array
        b - (M + E) z_0.
    solve, rest : callable
        v -> z = M^-1 v, and z -> E z.
    space : Space
        The inner product.
    tolerance : float
        Norm of the residual to end at.
    most : int
        Limit on the solutions.

    Examples
    --------
    >>> import numpy as np
    >>> E = np.array([[0.0, 2.0], [1.0, 0.0]])
    >>> b = np.array([1.0, 1.0])
    >>> z, y, left = flexible_gmres(
    ...     -E @ b, lambda v: v, lambda z: E @ z, Space(), tolerance=1e-12, most=2
    ... )
    >>> ((np.eye(2) + E) @ (b + sum(y_j * z_j for y_j, z_j in zip(y, z)))).round(12).tolist()
    [1.0, 1.0]
    """
    beta = space.norm(residual)
    solutions, basis, H = list[Z](), [residual / beta if beta else residual], np.zeros((1, 0))
    y, left = np.zeros(0), beta
    while left > tolerance and len(solutions) < most:
        solutions.append(solve(basis[-1]))
        w = basis[-1] + rest(solutions[-1])
        h = np.zeros(len(basis))
        for _ in range(2):
            change = np.array(space.dots(*((v, w) for v in basis)))
            w = w - sum(c * v for c, v in zip(change, basis, strict=True))
            h += change
        size = space.norm(w)
        H = np.vstack([np.hstack([H, h[:, None]]), np.append(np.zeros(H.shape[1]), size)])
        right = np.append(beta, np.zeros(len(basis)))
        y = np.linalg.lstsq(H, right, rcond=None)[0]
        left = float(np.linalg.norm(right - H @ y))
        if not size > 0.0:
            break
        basis.append(w / size)
    return solutions, y, left
