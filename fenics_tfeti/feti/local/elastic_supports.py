"""Soft elastic supports: the ground that holds a subdomain becomes a part of it.

A support that is soft beside the subdomain leaves rigid body modes R_s of small energy,
R_s'KR_s = diag(s). Such modes belong into the coarse space: with them outside, K^+ and F are as
large as 1 / s. So the ground is set free too. It gets an unknown y_j for each soft mode, and moves
along with it by q_j = y_j sqrt(tau / s_j). The supports are strained by the difference,

    1/2 (u - R_s q)'K(u - R_s q) = 1/2 [u; y]' [ K, -V; -V', tau I ] [u; y],

with V = K R_s diag(tau / s)^(1/2). This stiffness is positive semidefinite, and its kernel is known
exactly: rigid motions of the subdomain with its ground. An equality row for each y_j, y_j = 0,
holds the ground (`constraints.ground`); its multiplier is the force of the support in that mode.
With y = o the energy is that of K, so the solution is that of the given problem, and Total FETI
applies to the subdomain with its ground as to any other.

The scale of y makes the flexibility of its row 1 / tau for every s, as for the nodes of the
subdomain where tau is a diagonal entry of K.

A pressure that follows the surface of a part of a body does to translations R_s of it what it does
to the border of that part: K R_s is not zero, but R_s'KR_s is. The same matrix, with |K R_s| for s
in V and zero for tau I, has the kernel of rigid motions then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.local.rigid_body_modes import low_energy_modes
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.tolerances import FEW, ZERO, rounding
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class FloatingSubdomain:
    """A subdomain, with the ground of its soft supports."""

    stiffness: sp.csr_matrix  # K_i (n + g, n + g), the ground's g unknowns last [N/m]
    kernel: Vector  # R_i (n + g, k); the part of the n displacements is orthonormal
    grounds: int  # g


def set_free(subdomain: Subdomain) -> FloatingSubdomain:
    """Return a subdomain with the ground of its soft supports as unknowns."""
    K = subdomain.stiffness
    R, energies = low_energy_modes(subdomain)
    is_tangent = isinstance(subdomain.kernel, str) and subdomain.kernel == "translations"
    if not (is_tangent or energies.any()):
        return FloatingSubdomain(K, R, 0)
    tau, forces = float(K.diagonal().mean()), forces_of_motions(K, R)
    size = np.where(energies > 0.0, energies, np.linalg.norm(forces, axis=0))
    soft = np.flatnonzero(size > ZERO * tau if is_tangent else energies)
    if not soft.size:
        return FloatingSubdomain(K, R, 0)
    V = sp.csr_matrix(-forces[:, soft] * np.sqrt(tau / size[soft]))
    ground = sp.diags(tau * energies[soft] / size[soft])
    stiffness = sp.bmat([[K, V], [V.T, ground]], format="csr")
    stiffness.sort_indices()
    follow = np.zeros((soft.size, R.shape[1]))
    follow[np.arange(soft.size), soft] = np.sqrt(size[soft] / tau)
    return FloatingSubdomain(stiffness, np.vstack([R, follow]), int(soft.size))


def forces_of_motions(K: sp.csr_matrix, R: Vector) -> Vector:
    """Return KR without what rounding leaves where nothing resists."""
    KR = K @ R
    return np.where(np.abs(KR) > rounding(abs(K) @ np.abs(R), FEW), KR, 0.0)
