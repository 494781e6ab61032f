"""Rigid motions of whole bodies: what resists them, and their names for messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import first_few
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.local.frames import in_frame, out_of_frame
from fenics_tfeti.feti.local.rigid_body_modes import describe_motion, raw_modes
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import FEW, MANY, NEGLIGIBLE, rounding
from fenics_tfeti.parallel import count_over_ranks, largest_of_ranks
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class BodyMotions:
    """Rigid motions of whole bodies, in terms of the subdomains' modes.

    The unit of a motion is a root mean square displacement of 1 over the nodes of the body, and
    rows of B are taken with unit length: what resists is a matter of geometry, and depends neither
    on units nor on the mesh.
    """

    basis: sp.csr_matrix  # T (coarse, modes * bodies): R T z moves each body rigidly
    moved: sp.csr_matrix  # B R T (m, modes * bodies) on the rows held, without rounding
    # E (bodies, modes, modes): elastic supports resist ||E z||, outside the kernel of K
    supports: Vector
    rounding: float  # size that rounding may leave in `moved`

    @property
    def modes(self) -> int:
        """Number of motions of a body."""
        return self.supports.shape[1]

    @property
    def of_coarse(self) -> NDArray[np.int64]:
        """The body of each coarse unknown."""
        first = self.basis.indices[self.basis.indptr[:-1]]
        return first.astype(np.int64) // np.diff(self.basis.indptr)


def body_motions(
    system: TornSystem,
    kernels: Sequence[Vector],
    constraints: Constraints,
    everyone: sp.csr_matrix,
) -> BodyMotions:
    """Measure what rigid motions of bodies do to the constraints.

    R_i are in the frames of the subdomains; `everyone` is G' with the columns of all ranks,
    (m, coarse), in the rows that this rank holds. Collective.
    """
    basis, supports, _, distance = motions_and_supports(system, kernels)
    # also that of coordinates far from the origin
    trace = max(rounding(1.0, MANY), rounding(distance, FEW))
    lengths = constraints.lengths_of_rows()
    moved = sp.diags(1.0 / np.where(lengths > 0.0, lengths, 1.0)) @ (everyone @ basis)
    # gluing rows resist no motion of a whole body; rounding leaves traces of them
    moved.data[np.abs(moved.data) <= trace] = 0.0
    moved.eliminate_zeros()
    return BodyMotions(basis, moved.tocsr(), supports, trace)


def motions_and_supports(
    system: TornSystem, kernels: Sequence[Vector]
) -> tuple[sp.csr_matrix, Vector, list[Vector], float]:
    """Return T and E of `BodyMotions`, their motions, and the largest |x| / body size.

    The motions are columns (modes, modes) of combinations of each body's raw modes, about its
    centre and in units of its size. Collective.
    """
    comm = system.comm
    gdim = system.gdim
    modes = 3 if gdim == 2 else 6
    centres, sizes, nodes = centres_and_sizes(system)
    bodies = sizes.size

    blocks, gram, outside = [], np.zeros((bodies, modes, modes)), np.zeros((bodies, modes, modes))
    distance = 0.0
    for subdomain, R in zip(system.subdomains, kernels, strict=True):
        body = subdomain.body
        x = (subdomain.coordinates - centres[body]) / sizes[body]
        raw = in_frame(raw_modes(x, np.zeros(gdim)), subdomain.frame)
        # without the rows of the ground of soft supports
        inside = R[: subdomain.size].T @ raw
        blocks.append((body, inside))
        gram[body] += raw.T @ raw / nodes[body]
        # not squared: what resists little would be lost to rounding
        rest = (raw - R[: subdomain.size] @ inside) / np.sqrt(nodes[body])
        outside[body] = np.linalg.qr(np.vstack([outside[body], rest]), mode="r")
        distance = max(distance, float(np.abs(subdomain.coordinates).max()) / sizes[body])
    gram, outside = comm.allreduce(gram), np.concatenate(comm.allgather(outside), axis=1)
    outside = np.array([np.linalg.qr(e, mode="r") for e in outside])

    # motions of each body that are orthonormal over its torn nodes, in the mean
    inverse = [_orthonormal_motions(g) for g in gram]
    rows = [sp.csr_matrix((0, modes * bodies))]
    for body, inside in blocks:
        data = (inside @ inverse[body]).ravel()
        columns = np.tile(body * modes + np.arange(modes), len(inside))
        indptr = modes * np.arange(len(inside) + 1)
        shape = (len(inside), modes * bodies)
        rows.append(sp.csr_matrix((data, columns, indptr), shape=shape))
    basis = sp.vstack(comm.allgather(sp.vstack(rows, format="csr")), format="csr")
    # motions that move no node count as resisted
    still = [np.diag((~t.any(axis=0)).astype(float)) for t in inverse]
    scaled = [
        np.linalg.qr(np.vstack([e @ t, d]), mode="r")
        for t, e, d in zip(inverse, outside, still, strict=True)
    ]
    supports: Vector = np.array(scaled).reshape(bodies, modes, modes)
    supports[np.abs(supports) <= rounding(1.0, MANY)] = 0.0
    return basis, supports, inverse, largest_of_ranks(comm, distance)


def _orthonormal_motions(gram: Vector) -> Vector:
    """Return T with T' gram T = I; zero columns for what moves no node, as about a line."""
    if not gram.any():
        return gram
    values, vectors = np.linalg.eigh(gram)
    moving = values > NEGLIGIBLE**2 * values[-1]
    if moving.all():
        return np.linalg.inv(np.linalg.cholesky(gram)).T
    return vectors * np.where(moving, 1.0 / np.sqrt(np.where(moving, values, 1.0)), 0.0)


def centres_and_sizes(system: TornSystem) -> tuple[Vector, Vector, Vector]:
    """Return the mean places (bodies, gdim), sizes and numbers of nodes of all bodies."""
    bodies = count_over_ranks(system.comm, system.bodies)
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
    return centres, np.where(sizes > 0.0, sizes, 1.0), counts


def describe_body_motions(
    system: TornSystem,
    kernels: Sequence[Vector],
    own_motions: sp.csr_matrix,
    either_way: bool = False,
    negligible: float = NEGLIGIBLE,
) -> list[str]:
    """Name the bodies that take part in each of some motions, and how each of them moves.

    Returns "body: motion; body: motion" for each motion, on all ranks; collective if there are
    motions. A motion is R xi, of which each rank gives its part of xi as a row (k, own). With
    either_way the opposite motion is meant as well; parts up to negligible, relative to the motion,
    are left out.
    """
    if not own_motions.shape[0]:
        return []
    centres, sizes, _ = centres_and_sizes(system)
    ends = np.cumsum([0, *(R.shape[1] for R in kernels)])

    def own_parts(own: Numbers, values: Vector) -> dict[int, tuple[float, str]]:
        """Return how far, and in words how, each body moves on this rank."""
        parts: dict[int, tuple[float, str]] = {}
        moving = np.searchsorted(ends, own, side="right") - 1
        for i in np.unique(moving):
            subdomain, chosen = system.subdomains[i], moving == i
            turned = kernels[i][: subdomain.size, own[chosen] - ends[i]] @ values[chosen]
            displacement = out_of_frame(turned, subdomain.frame)
            size = float(np.abs(displacement).max(initial=0.0))
            if size > parts.get(subdomain.body, (0.0, ""))[0]:
                about = centres[subdomain.body], sizes[subdomain.body]
                words = describe_motion(
                    subdomain.coordinates, displacement, either_way, negligible, about
                )
                parts[subdomain.body] = size, words
        return parts

    rows = pairwise(own_motions.indptr.tolist())
    parts = [own_parts(own_motions.indices[i:j], own_motions.data[i:j]) for i, j in rows]
    of_ranks = system.comm.allgather(parts)
    return [_joined(system, parts, negligible) for parts in zip(*of_ranks, strict=True)]


def _joined(
    system: TornSystem, parts: Sequence[dict[int, tuple[float, str]]], negligible: float
) -> str:
    """Join the motions of bodies, each in the words of the rank on which it moves farthest."""
    merged: dict[int, tuple[float, str]] = {}
    for part in parts:
        for body, value in part.items():
            merged[body] = max(value, merged.get(body, (0.0, "")))
    largest = max((size for size, _ in merged.values()), default=0.0)
    described = [
        f"{system.body_name(body)}: {words}"
        for body, (size, words) in sorted(merged.items())
        if size > negligible * largest
    ]
    return "; ".join(first_few(described, 3, "bodies"))
