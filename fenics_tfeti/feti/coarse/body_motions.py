"""Rigid motions of whole bodies: what resists them, and their names for messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.local.rigid_body_modes import describe_motion, raw_modes
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import UNRESISTED

__all__ = ["BodyMotions", "body_motions", "describe_body_motion"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# what rounding leaves of rigid motions of a body in its gluing rows
_TRACE = 1e-13


@dataclass(frozen=True)
class BodyMotions:
    """Rigid motions of whole bodies, in terms of the subdomains' modes.

    Attributes
    ----------
    basis : (coarse, modes * bodies) scipy.sparse.csr_matrix
        T: R T z moves each body rigidly, orthonormal columns for each body.
    held : (modes * bodies, modes * bodies) array
        How elastic supports and the equality rows of B resist the motions, as a Gram matrix. Rows
        are taken with unit length: what resists is a matter of geometry.
    contact : (modes * bodies, owned inequality rows) scipy.sparse.csr_matrix
        What the motions do to the contact rows, again of unit length.
    """

    basis: sp.csr_matrix
    held: Vector
    contact: sp.csr_matrix


def body_motions(
    system: TornSystem,
    kernels: Sequence[Vector],
    constraints: Constraints,
    everyone: sp.csr_matrix,
) -> BodyMotions:
    """Measure how the constraints resist rigid motions of bodies.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    kernels : sequence of (n_i, k_i) arrays
        R_i of this rank's subdomains.
    constraints : Constraints
        B.
    everyone : (m, coarse) scipy.sparse.csr_matrix
        G' with the columns of all ranks, in the rows that this rank holds.
    """
    basis, energy = _motions_and_energy(system, kernels)
    owned = constraints.layout.owned
    # (rows of B, motions): what each motion does to rows of unit length
    moved = sp.diags(1.0 / constraints.row_lengths[:owned]) @ (everyone[:owned] @ basis)
    # gluing rows resist no motion of a whole body; rounding leaves traces of them
    moved.data[np.abs(moved.data) <= _TRACE] = 0.0
    moved.eliminate_zeros()
    equality = constraints.equality[:owned]
    held = moved[np.flatnonzero(equality)]
    return BodyMotions(
        basis,
        system.comm.allreduce((held.T @ held).toarray()) + energy,
        moved[np.flatnonzero(~equality)].T.tocsr(),
    )


def _motions_and_energy(
    system: TornSystem, kernels: Sequence[Vector]
) -> tuple[sp.csr_matrix, Vector]:
    """Return T, and the energy of the motions outside the kernel of K (elastic supports)."""
    comm = system.comm
    gdim = system.gdim
    bodies = comm.allreduce(max((s.body + 1 for s in system.subdomains), default=0), MPI.MAX)
    modes = 3 if gdim == 2 else 6
    centres, sizes = _centres_and_sizes(system, bodies)

    blocks, gram, energy = [], np.zeros((bodies, modes, modes)), np.zeros((bodies, modes, modes))
    for subdomain, R in zip(system.subdomains, kernels, strict=True):
        body = subdomain.body
        raw = raw_modes((subdomain.coordinates - centres[body]) / sizes[body], np.zeros(gdim))
        inside = R.T @ raw
        blocks.append((body, inside))
        gram[body] += raw.T @ raw
        energy[body] += raw.T @ raw - inside.T @ inside
    gram, energy = comm.allreduce(gram), comm.allreduce(energy)

    # orthonormal motions of each body over its torn nodes
    inverse = [np.linalg.inv(np.linalg.cholesky(g)).T if g.any() else g for g in gram]
    rows = [sp.csr_matrix((0, modes * bodies))]
    for body, inside in blocks:
        data = (inside @ inverse[body]).ravel()
        columns = np.tile(body * modes + np.arange(modes), len(inside))
        indptr = modes * np.arange(len(inside) + 1)
        shape = (len(inside), modes * bodies)
        rows.append(sp.csr_matrix((data, columns, indptr), shape=shape))
    basis = sp.vstack(comm.allgather(sp.vstack(rows, format="csr")), format="csr")
    scaled = [t.T @ e @ t for t, e in zip(inverse, energy, strict=True)]
    # rounding leaves traces of 1e-16 in what should vanish
    scaled = [np.where(np.abs(e) > UNRESISTED, e, 0.0) for e in scaled]
    return basis, block_diag(*scaled) if bodies else np.zeros((0, 0))


def _centres_and_sizes(system: TornSystem, bodies: int) -> tuple[Vector, Vector]:
    sums, counts = np.zeros((bodies, system.gdim)), np.zeros(bodies)
    for subdomain in system.subdomains:
        sums[subdomain.body] += subdomain.coordinates.sum(axis=0)
        counts[subdomain.body] += subdomain.nodes.size
    counts = np.maximum(system.comm.allreduce(counts), 1.0)
    centres = system.comm.allreduce(sums) / counts[:, None]
    sizes = np.zeros(bodies)
    for subdomain in system.subdomains:
        reach = np.abs(subdomain.coordinates - centres[subdomain.body]).max()
        sizes[subdomain.body] = max(sizes[subdomain.body], reach)
    system.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
    return centres, np.where(sizes > 0.0, sizes, 1.0)


def describe_body_motion(
    system: TornSystem, kernels: Sequence[Vector], own_motion: Vector, either_way: bool = False
) -> list[str]:
    """Name the bodies that take part in a motion, and how each of them moves.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    kernels : sequence of (n_i, k_i) arrays
        R_i of this rank's subdomains.
    own_motion : array
        This rank's part of the coarse vector xi of the motion R xi.
    either_way : bool
        Whether the opposite motion is meant as well.

    Returns
    -------
    list of str
        "body: motion" for each body, on all ranks.
    """
    ends = np.cumsum([0, *(R.shape[1] for R in kernels)])
    parts: dict[int, tuple[float, str]] = {}
    for i, (subdomain, R) in enumerate(zip(system.subdomains, kernels, strict=True)):
        displacement = R @ own_motion[ends[i] : ends[i + 1]]
        size = float(np.abs(displacement).max(initial=0.0))
        if size > parts.get(subdomain.body, (0.0, ""))[0]:
            words = describe_motion(subdomain.coordinates, displacement, either_way)
            parts[subdomain.body] = size, words
    merged: dict[int, tuple[float, str]] = {}
    for part in system.comm.allgather(parts):
        for body, value in part.items():
            merged[body] = max(value, merged.get(body, (0.0, "")))
    largest = max((size for size, _ in merged.values()), default=0.0)
    return [
        f"{system.body_name(body)}: {words}"
        for body, (size, words) in sorted(merged.items())
        if size > 1e-6 * largest
    ]
