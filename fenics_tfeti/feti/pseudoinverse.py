"""The generalised inverse K_i^+ of a floating subdomain (sec. 11.7)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import FactorizationError, format_point
from fenics_tfeti.feti.cholesky import SparseCholesky
from fenics_tfeti.feti.fixing_nodes import fixing_nodes
from fenics_tfeti.feti.torn_system import Subdomain

__all__ = ["GeneralisedInverse", "Pseudoinverse", "regularised_stiffness"]

Vector = NDArray[np.float64]
GeneralisedInverse = Literal["fixing_nodes", "null_pivots"]


def regularised_stiffness(
    stiffness: sp.csr_matrix, R: Vector, fixed: NDArray[np.int64]
) -> sp.csr_matrix:
    """Return K + rho Q with Q = R_F (R_F'R_F)^{-1} R_F' on the fixed unknowns, rho = max diag K.

    Its inverse is the K^+ of (11.34) with S^+ = (S + rho Q)^{-1}: block elimination of the
    remaining unknowns gives the Schur complement S + rho Q, and the rest of (11.34) is the rest of
    the elimination.

    Parameters
    ----------
    stiffness : (n, n) scipy.sparse.csr_matrix
        K.
    R : (n, k) array
        Basis of its kernel.
    fixed : (s,) integer array
        F, the unknowns of the fixing nodes.

    Returns
    -------
    (n, n) scipy.sparse.csr_matrix
        Symmetric positive definite.
    """
    if R.shape[1] == 0:
        return stiffness
    basis = np.linalg.qr(R[fixed])[0]
    rho = stiffness.diagonal().max()
    s = fixed.size
    Q = sp.csr_matrix(
        (rho * (basis @ basis.T).ravel(), (np.repeat(fixed, s), np.tile(fixed, s))),
        shape=stiffness.shape,
    )
    return (stiffness + Q).tocsr()


class Pseudoinverse:
    """K_i^+ with K K^+ K = K (11.28).

    Parameters
    ----------
    subdomain : Subdomain
        Stiffness and coordinates.
    R : (n, k) array
        Orthonormal basis of the kernel of K_i.
    package : str
        "cholmod" or "mumps".
    method : {"fixing_nodes", "null_pivots"}
        (11.32)-(11.34), or the null pivots that MUMPS finds in the singular matrix.
    number : int
        M, the number of fixing nodes.

    Raises
    ------
    FactorizationError
        If K_i is not positive semidefinite or its kernel is not the one of its rigid body modes.
    """

    def __init__(
        self,
        subdomain: Subdomain,
        R: Vector,
        package: str,
        method: GeneralisedInverse = "fixing_nodes",
        number: int = 8,
    ) -> None:
        K, gdim = subdomain.stiffness, subdomain.coordinates.shape[1]
        self.size = subdomain.size
        try:
            if method == "null_pivots":
                self._factor = SparseCholesky(K, package, null_pivots=True)
            else:
                nodes = fixing_nodes(K, subdomain.coordinates, number)
                fixed = (gdim * nodes[:, None] + np.arange(gdim)).ravel()
                self._factor = SparseCholesky(regularised_stiffness(K, R, fixed), package)
        except FactorizationError as error:
            place = format_point(
                subdomain.coordinates.mean(axis=0), float(np.abs(subdomain.coordinates).max())
            )
            raise FactorizationError(
                f"subdomain of body {subdomain.body} at {place}: "
                f"{error}. Is the form elasticity with positive moduli, and each subdomain "
                "connected through facets?"
            ) from error
        if method == "null_pivots" and self._factor.deficiency != R.shape[1]:
            raise FactorizationError(
                f"MUMPS found {self._factor.deficiency} null pivots in a subdomain of body "
                f"{subdomain.body} whose kernel has dimension {R.shape[1]}. Use the option "
                "generalised_inverse='fixing_nodes'"
            )

    def solve(self, b: Vector) -> Vector:
        """Apply K_i^+ to a vector (n,) or to the columns of a matrix (n, k)."""
        return self._factor.solve(b)

    @property
    def entries(self) -> int:
        """Entries of the factor."""
        return self._factor.entries
