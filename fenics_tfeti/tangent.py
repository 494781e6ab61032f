"""Positive semidefinite tangents of torn subdomains, with all rigid motions as kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.local.fixing_nodes import fixing_nodes
from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.system import Subdomain, TornSystem


def prepare_tangents(
    system: TornSystem, kind: Literal["auto", "exact", "projected"] = "auto"
) -> TornSystem:
    """Return the system with projected tangents P'KP, remaining negative eigenvalues flipped."""
    return replace(system, subdomains=[_projected(s) for s in system.subdomains])


def _projected(s: Subdomain) -> Subdomain:
    K, x, gdim = s.stiffness, s.coordinates, s.coordinates.shape[1]
    if s.frame is not None:
        T = sp.kron(sp.identity(len(x)), s.frame).tocsr()
        K = (T @ K @ T.T).tocsr()
    R = rigid_body_modes(x)
    KR, mean = K @ R, K.diagonal().mean()
    if np.abs(KR).max() <= 1e-13 * mean:
        return s
    nodes = fixing_nodes(K, x, 8)
    at = (gdim * nodes[:, None] + np.arange(gdim)).ravel()
    A = np.zeros_like(R)
    A[at] = R[at] @ np.linalg.inv(R[at].T @ R[at])
    small = 1e-13 * K.diagonal().max()
    low = sp.csr_matrix(A) @ sp.csr_matrix(np.where(np.abs(KR) > small, KR, 0.0)).T
    A = sp.csr_matrix(A)
    K = (K - low - low.T + A @ sp.csr_matrix(R.T @ KR) @ A.T).tocsr()
    w, X = np.linalg.eigh(K.toarray())
    X, w = X[:, w < -1e-9 * mean], w[w < -1e-9 * mean]
    if w.size:
        K = (K + sp.csr_matrix((X * (2.0 * abs(w))) @ X.T)).tocsr()
    return replace(s, stiffness=K, frame=None)
