"""Flexible GMRES, preconditioned from the right, for a matrix that is known by products.

z_j = M^-1 v_j,  A z_j = h_1j v_1 + ... + h_(j+1)j v_(j+1),  x = sum_j y_j z_j with the least
|b - A x|, where v_1 = b / |b|. M may differ from step to step, and z may have any type. Saad, SIAM
J. Sci. Comput. 14 (1993) 461-469.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from fenics_tfeti.qp.space import Space
from fenics_tfeti.typing import Vector

Z = TypeVar("Z")


def gmres(
    step: Callable[[Vector], tuple[Z, Vector]],
    b: Vector,
    space: Space,
    *,
    tolerance: float,
    max_it: int,
) -> tuple[list[Z], Vector, float]:
    """Return solutions z_j, their coefficients y_j, and the norm of the residual that is left.

    Parameters
    ----------
    step : callable
        v -> z = M^-1 v and A z; without preconditioner z is v.
    b : (n,) array
        Right-hand side, or the residual of a first solution.
    space : Space
        The inner product.
    tolerance : float
        Norm of the residual to end at.
    max_it : int
        Limit on the steps. There are no restarts.

    Examples
    --------
    >>> A = np.array([[2.0, 1.0], [0.0, 4.0]])
    >>> b = np.array([3.0, 4.0])
    >>> z, y, left = gmres(lambda v: (v, A @ v), b, Space(), tolerance=1e-12, max_it=2)
    >>> sum(y_j * z_j for y_j, z_j in zip(y, z)).round(12).tolist()
    [1.0, 1.0]
    """
    beta = left = space.norm(b)
    solutions, H, y = list[Z](), np.zeros((1, 0)), np.zeros(0)
    if left <= tolerance:
        return solutions, y, left
    basis = [b / beta]
    while left > tolerance and len(solutions) < max_it:
        solution, image = step(basis[-1])
        solutions.append(solution)
        h, size = np.zeros(len(basis)), space.norm(image)
        # twice, for what rounding leaves
        for _ in range(2):
            parts = np.array(space.dots(*((v, image) for v in basis)))
            image = image - sum(part * v for part, v in zip(parts, basis, strict=True))
            h += parts
        length = space.norm(image)
        H = np.pad(H, ((0, 1), (0, 1)))
        H[:, -1] = [*h, length]
        right = np.append(beta, np.zeros(len(basis)))
        y = np.linalg.lstsq(H, right, rcond=None)[0]
        left = float(np.linalg.norm(right - H @ y))
        if length <= np.finfo(float).eps * size:
            break
        basis.append(image / length)
    return solutions, y, left
