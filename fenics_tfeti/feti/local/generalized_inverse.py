"""The generalized inverse K_i^+ of a floating subdomain (sec. 11.7)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import FactorizationError, format_point
from fenics_tfeti.feti.factors.cholesky import (
    SparseFactor,
    downdated_cholesky,
    sparse_cholesky,
    sparse_ldl,
)
from fenics_tfeti.feti.factors.supernodal import Ordering, Orderings
from fenics_tfeti.feti.local.fixing_nodes import FIXING_NODES, fixing_nodes, unknowns_of_nodes
from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.local.symmetry import SymmetryGroup
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Numbers, Operator, Vector


def regularized_stiffness(
    stiffness: sp.csr_matrix, R: Vector, fixed: NDArray[np.int64]
) -> sp.csr_matrix:
    """Return K + rho Q with Q = R_F (R_F'R_F)^{-1} R_F' on the fixed unknowns, rho = max diag K.

    For a basis R (n, k) of the kernel of K and F (s,), the unknowns of the fixing nodes, it is
    regular, with as many negative eigenvalues as K. Its inverse is the K^+ of (11.34) with
    S^+ = (S + rho Q)^{-1}: block elimination of the remaining unknowns gives the Schur complement
    S + rho Q, and the rest of (11.34) is the rest of the elimination.
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


def _indefinite_factor(
    K: sp.csr_matrix,
    R: Vector,
    rigid: Vector,
    fixed: Numbers,
    package: str,
    gdim: int,
    last: Ordering,
) -> SparseFactor:
    """Return the factor of K + rho Q of a tangent K, whose kernel R is a part of its rigid motions.

    Where the other rigid motions alone have negative energies, as under pressure, K with all of
    them held is definite.
    """
    resisted = np.linalg.qr(rigid[fixed])[0]
    basis = np.linalg.qr(R[fixed])[0]
    left = np.linalg.svd(resisted - basis @ (basis.T @ resisted), full_matrices=False)[0]
    U = np.zeros((K.shape[0], rigid.shape[1] - R.shape[1]))
    U[fixed] = np.sqrt(K.diagonal().max()) * left[:, : U.shape[1]]
    try:
        return downdated_cholesky(regularized_stiffness(K, rigid, fixed), U, package, gdim, last)
    except FactorizationError:
        return sparse_ldl(regularized_stiffness(K, R, fixed))


class GeneralizedInverse:
    """K_i^+ with K K^+ K = K (11.28); zero for a rigid body.

    R (n, k) is an orthonormal basis of the kernel of K_i, and `number` is M, the number of fixing
    nodes. The stiffness, by default that of the subdomain, may have unknowns beyond those of the
    nodes. Symmetries leave K_i as it is; K_i^+ is to have them too. `orderings` are those of
    matrices before, and take in this one. Raises `FactorizationError` if the kernel of K_i is not
    R, or K_i is not positive semidefinite but all rigid body modes are to be its kernel.
    """

    def __init__(
        self,
        subdomain: Subdomain,
        R: Vector,
        package: str,
        number: int = FIXING_NODES,
        stiffness: sp.csr_matrix | None = None,
        symmetries: SymmetryGroup | None = None,
        orderings: Orderings | None = None,
    ) -> None:
        gdim = subdomain.coordinates.shape[1]
        K = subdomain.stiffness if stiffness is None else stiffness
        self.size = K.shape[0]
        self._symmetries = symmetries
        self.negative = 0  # negative eigenvalues of K_i
        self._factor: SparseFactor | None = None
        if subdomain.is_rigid:
            return
        images = symmetries.nodes(gdim) if symmetries else None
        # of the tangents of this subdomain in Newton steps before
        name = hash(subdomain.nodes.tobytes())
        last = ({} if orderings is None else orderings).setdefault(name, Ordering())
        x, is_definite = subdomain.coordinates_in_frame, subdomain.kernel == "rigid"
        held = R if is_definite else rigid_body_modes(x)
        try:
            fixed = unknowns_of_nodes(fixing_nodes(x, held, number, images), gdim)
            if is_definite:
                regularized = regularized_stiffness(K, R, fixed)
                self._factor = sparse_cholesky(regularized, package, width=gdim, last=last)
            else:
                self._factor = indefinite = _indefinite_factor(
                    K, R, held, fixed, package, gdim, last
                )
                self.negative = indefinite.negative
        except FactorizationError as error:
            place = format_point(
                subdomain.coordinates.mean(axis=0), float(np.abs(subdomain.coordinates).max())
            )
            raise FactorizationError(
                f"subdomain of body {subdomain.body} at {place}: "
                f"{error}. Is the form elasticity with positive moduli, and each subdomain "
                "connected through facets?"
            ) from error

    @property
    def symmetries(self) -> SymmetryGroup:
        """The symmetries of K_i^+."""
        return self._symmetries or SymmetryGroup.trivial(self.size)

    def solve(self, b: Vector) -> Vector:
        """Apply K_i^+ to a vector (n,) or to the columns of a matrix (n, k)."""
        return np.zeros_like(b) if self._factor is None else self._factor.solve(b)

    def between(self, unknowns: Numbers) -> Operator | None:
        """Return K_i^+ between some unknowns, for rows (k, b), where that is compiled."""
        return None if self._factor is None else self._factor.between(unknowns)

    @property
    def entries(self) -> int:
        """Entries of the factor."""
        return 0 if self._factor is None else self._factor.entries
