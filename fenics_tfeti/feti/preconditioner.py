"""Lumped and Dirichlet preconditioners in the face (sec. 11.12)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.cholesky import SparseCholesky
from fenics_tfeti.feti.dual import DualOperator
from fenics_tfeti.feti.torn_system import Subdomain

__all__ = ["boundary_operator"]

Vector = NDArray[np.float64]


def boundary_operator(
    kind: Literal["lumped", "dirichlet"],
    F: DualOperator,
    subdomains: Sequence[Subdomain],
    package: str,
) -> Callable[[Vector], Vector]:
    """Return x -> B D^{-1} S D^{-1} B'x, S the stiffness that displaced subdomain boundaries feel.

    Lumped takes K_bb, the interior held still; Dirichlet the Schur complement
    K_bb - K_bi K_ii^{-1} K_ib, the interior free to follow. The boundary is what B has entries on.
    As B D^{-1} B' = I, this is the scaled B_D S B_D' with B_D = (B D^{-1} B')^{-1} B D^{-1}.

    Parameters
    ----------
    kind : {"lumped", "dirichlet"}
        Which.
    F : DualOperator
        For B.
    subdomains : sequence of Subdomain
        This rank's subdomains.
    package : str
        Package for the factors of K_ii.
    """
    B = F.constraints.matrix
    on_boundary = np.asarray(abs(B).sum(axis=0)).ravel() > 0.0
    reactions = [
        _reaction(kind, subdomain.stiffness, on_boundary[part], package)
        for subdomain, part in zip(subdomains, F.slices, strict=True)
    ]

    B_D = (B @ sp.diags(1.0 / F.constraints.weights)).tocsr()

    def apply(x: Vector) -> Vector:
        displacement = B_D.T @ x
        force = np.zeros_like(displacement)
        for reaction, part in zip(reactions, F.slices, strict=True):
            force[part] = reaction(displacement[part])
        return F.constraints.multipliers.sum(B_D @ force)

    return apply


def _reaction(
    kind: str, K: sp.csr_matrix, on_boundary: NDArray[np.bool_], package: str
) -> Callable[[Vector], Vector]:
    """Return the forces on a subdomain's boundary as a function of its displacements there."""
    interior = np.flatnonzero(~on_boundary)
    # displacements vanish in the interior, so K itself acts as K_bb; B reads boundary forces only
    if kind == "lumped" or interior.size == 0:
        return lambda u: K @ u
    K_interior = K[interior]
    factor = SparseCholesky(K_interior[:, interior].tocsr(), package)

    def schur_complement(u: Vector) -> Vector:
        follow = u.copy()
        follow[interior] = -factor.solve(K_interior @ u)
        reaction: Vector = K @ follow
        return reaction

    return schur_complement
