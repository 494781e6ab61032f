"""The matrices of a torn system on one rank as dense arrays, in the notation of the chapter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from fenics_tfeti.feti import TornSolver

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class DenseSystem:
    """K, f, R and B of all subdomains, the weights D of their unknowns, and G = R'B'."""

    K: Matrix
    f: Matrix
    R: Matrix
    B: Matrix
    D: Matrix

    @staticmethod
    def of(solver: TornSolver) -> DenseSystem:
        setup, subdomains = solver.setup, solver.system.subdomains
        return DenseSystem(
            scipy.linalg.block_diag(*(s.stiffness.toarray() for s in subdomains)),
            np.concatenate([s.load for s in subdomains]),
            scipy.linalg.block_diag(*setup.local.kernels),
            setup.constraints.matrix.toarray(),
            np.diag(setup.constraints.weights),
        )

    @property
    def G(self) -> Matrix:
        return self.R.T @ self.B.T

    @property
    def F(self) -> Matrix:
        """B K^+ B' with the Moore-Penrose inverse; PFP is the same for any generalized inverse."""
        return self.B @ np.linalg.pinv(self.K, rcond=1e-10, hermitian=True) @ self.B.T

    def projector(self, rows: Matrix | None = None) -> Matrix:
        """Return P = I - G'(GG')^+ G, for some rows of B only if these are given."""
        chosen = np.ones(len(self.B), dtype=bool) if rows is None else rows
        G = np.where(chosen, self.G, 0.0)
        return np.diag(chosen.astype(float)) - np.linalg.pinv(G, rcond=1e-10) @ G
