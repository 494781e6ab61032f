"""Lumped and Dirichlet preconditioners in the face (sec. 11.12)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import null_space

from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.local.cholesky import SparseCholesky
from fenics_tfeti.feti.local.congruence import times_rows
from fenics_tfeti.feti.local.generalized_inverse import regularized_stiffness

__all__ = ["interface_operator"]

Vector = NDArray[np.float64]

# singular value of R on the interface, relative to the largest, that is rounding
_NOT_MOVED = 1e-10


def interface_operator(
    kind: Literal["lumped", "dirichlet"],
    F: DualOperator,
    stiffness: Sequence[sp.csr_matrix],
    kernels: Sequence[Vector],
    package: str,
) -> Callable[[Vector], Vector]:
    """Return this rank's part of x -> B D^{-1} S D^{-1} B'x, S the stiffness of interfaces.

    Lumped takes K_bb, the interior held still; Dirichlet the Schur complement
    K_bb - K_bi K_ii^{-1} K_ib, the interior free to follow. The interface is what B has entries on.
    As B D^{-1} B' = I, this is the scaled B_D S B_D' with B_D = (B D^{-1} B')^{-1} B D^{-1}.

    Parameters
    ----------
    kind : {"lumped", "dirichlet"}
        Which.
    F : DualOperator
        For B.
    stiffness : sequence of (n, n) scipy.sparse.csr_matrix
        K_i of each class of congruent subdomains.
    kernels : sequence of (n, k) arrays
        Basis R_i of its kernel, of each class.
    package : str
        Package for the factors of K_ii.
    """
    interface = F.interface
    reactions = [
        _reaction(kind, K, R, local, package)
        for K, R, local in zip(stiffness, kernels, interface.unknowns, strict=True)
    ]
    flexibility = 1.0 / F.constraints.weights[interface.columns]

    def apply(x: Vector) -> Vector:
        displacements = interface.transposed @ x
        displacements *= flexibility
        forces = interface.apply(reactions, displacements)
        forces *= flexibility
        part: Vector = interface.matrix @ forces
        return part

    return apply


def _reaction(
    kind: str, K: sp.csr_matrix, R: Vector, local: NDArray[np.int64], package: str
) -> Callable[[Vector], Vector]:
    """Return the forces on a subdomain's interface as a function of its displacements there."""
    interior = np.setdiff1d(np.arange(K.shape[0]), local)
    rows = K[local]
    K_bb = rows[:, local].tocsr()
    if kind == "lumped" or 0 in (interior.size, local.size):
        return partial(times_rows, K_bb)
    K_bi = rows[:, interior].tocsr()
    K_ib = K_bi.T.tocsr()
    factor = SparseCholesky(_held_interior(K, R, local, interior), package)

    def schur_complement(u: Vector) -> Vector:
        follow = factor.solve(K_ib @ u.T if len(u) > 1 else K_ib @ u[0])
        reaction: Vector = times_rows(K_bb, u) - (K_bi @ follow).T
        return reaction

    return schur_complement


def _held_interior(
    K: sp.csr_matrix, R: Vector, local: NDArray[np.int64], interior: NDArray[np.int64]
) -> sp.csr_matrix:
    """Return K_ii, regularised for rigid motions that do not move the unknowns of the interface.

    These do no work on K_ib u, so that any generalized inverse of K_ii gives the same reactions.
    """
    K_ii = K[interior][:, interior].tocsr()
    left = null_space(R[local], rcond=_NOT_MOVED) if R.shape[1] else R
    if not left.shape[1]:
        return K_ii
    N = R[interior] @ left
    # as many unknowns as motions, which tell these apart best
    held = scipy.linalg.qr(N.T, mode="r", pivoting=True)[1][: left.shape[1]]
    return regularized_stiffness(K_ii, N, held.astype(np.int64))
