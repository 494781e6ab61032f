"""GMRES for systems of few unknowns whose matrix is known by products."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.typing import Operator, Vector


def gmres(apply: Operator, b: Vector, rtol: float) -> tuple[Vector, float]:
    """Return x with A x = b, up to a residual relative to |b|, and that residual.

    There are as many steps as unknowns at most, and no restarts.

    Examples
    --------
    >>> A = np.array([[2.0, 1.0], [0.0, 4.0]])
    >>> x, residual = gmres(lambda x: A @ x, np.array([3.0, 4.0]), 1e-12)
    >>> x.round(12).tolist()
    [1.0, 1.0]
    """
    size = float(np.linalg.norm(b))
    basis, images = np.zeros((b.size, 0)), np.zeros((b.size, 0))
    x, left = np.zeros_like(b), b
    while basis.shape[1] < b.size and np.linalg.norm(left) > rtol * size:
        new = left if not basis.shape[1] else images[:, -1]
        # twice, for what rounding leaves
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        length = float(np.linalg.norm(new))
        if length == 0.0:
            break
        basis = np.column_stack([basis, new / length])
        images = np.column_stack([images, apply(basis[:, -1])])
        coefficients = np.linalg.lstsq(images, b, rcond=None)[0]
        x, left = basis @ coefficients, b - images @ coefficients
    return x, float(np.linalg.norm(left)) / size if size > 0.0 else 0.0
