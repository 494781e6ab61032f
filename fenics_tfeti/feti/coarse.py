"""The natural coarse space: G = R'B', the projectors P and Q, and what G leaves free (sec. 11.8).

G with orthonormal rows is needed only through Q = G~'(G~G~')^{-1}G~ of G~ = R'B', so the coarse
matrix G~G~' is factored and T never formed. Where some rigid motions meet no constraint at all, the
coarse matrix is singular and a generalised inverse takes its place; Q is the same for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import block_diag, qr

from fenics_tfeti.feti.cholesky import SparseCholesky
from fenics_tfeti.feti.constraints import Constraints
from fenics_tfeti.feti.exchange import concatenate_ranks, first_of_rank
from fenics_tfeti.feti.rigid_body_modes import describe_motion, raw_modes
from fenics_tfeti.feti.torn_system import TornSystem

__all__ = ["BodyMotions", "CoarseSpace", "Projector", "describe_body_motion"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# ||B R xi||^2 / ||R xi||^2 of a rigid motion of a body below which no constraint resists it
_UNRESISTED = 1e-12


@dataclass(frozen=True)
class BodyMotions:
    """Rigid motions of whole bodies, in terms of the subdomains' modes.

    Attributes
    ----------
    basis : (coarse, modes * bodies) scipy.sparse.csr_matrix
        T: R T z moves each body rigidly, orthonormal columns for each body.
    energy : (modes * bodies, modes * bodies) array
        What of the motions is outside the kernel of K (elastic supports), as a Gram matrix.
    """

    basis: sp.csr_matrix
    energy: Vector


@dataclass(frozen=True)
class CoarseSpace:
    """G on this rank, and the bodies' rigid motions.

    Attributes
    ----------
    own : (coarse of this rank, m) scipy.sparse.csr_matrix
        The rows of G for this rank's subdomains; complete.
    all : (coarse, m) scipy.sparse.csr_matrix
        All rows of G, in the columns that this rank holds.
    first : int
        Number of this rank's first row.
    bodies : BodyMotions
        Rigid motions of bodies.
    kernels : (n, coarse of this rank) scipy.sparse.csr_matrix
        R = diag(R_i) of this rank's subdomains.
    constraints : Constraints
        The columns.
    package : str
        Package for the factors.
    """

    own: sp.csr_matrix
    all: sp.csr_matrix
    first: int
    bodies: BodyMotions
    kernels: sp.csr_matrix
    constraints: Constraints
    package: str

    @staticmethod
    def build(
        system: TornSystem, constraints: Constraints, kernels: Sequence[Vector], package: str
    ) -> CoarseSpace:
        """Form G = R'B' and exchange its shared columns with the neighbours.

        Parameters
        ----------
        system : TornSystem
            The subdomains.
        constraints : Constraints
            B.
        kernels : sequence of (n_i, k_i) arrays
            R_i of this rank's subdomains.
        package : str
            Package for the factors of coarse matrices.
        """
        n = constraints.matrix.shape[1]
        blocks = [sp.coo_matrix(R) for R in kernels]
        R = sp.block_diag(blocks, format="csr") if blocks else sp.csr_matrix((n, 0))
        own = (constraints.matrix @ R).T.tocsr()
        own.sum_duplicates()
        first, total = first_of_rank(system.comm, own.shape[0])
        coo = own.tocoo()
        rows = coo.row.astype(np.int64) + first
        columns = coo.col.astype(np.int64)
        theirs = constraints.multipliers.shared_entries(rows, columns, coo.data)
        complete = sp.csr_matrix(
            (
                np.concatenate([coo.data, theirs[2]]),
                (np.concatenate([rows, theirs[0]]), np.concatenate([columns, theirs[1]])),
            ),
            shape=(total, own.shape[1]),
        )
        return CoarseSpace(
            own, complete, first, _body_motions(system, kernels), R, constraints, package
        )

    @property
    def comm(self) -> MPI.Intracomm:
        """The ranks."""
        return self.constraints.multipliers.comm

    @property
    def size(self) -> int:
        """Number of rows of G."""
        return int(self.all.shape[0])

    def restrict_to_owned(self, columns: Mask) -> sp.csr_matrix:
        """Return all rows of G in the owned columns of a mask."""
        return self.all[:, np.flatnonzero(self._owned(columns))]

    def _owned(self, columns: Mask) -> Mask:
        return columns & (np.arange(columns.size) < self.constraints.multipliers.owned)

    def unresisted(self, columns: Mask) -> Vector:
        """Return the rigid motions of bodies that the chosen rows of B do not resist.

        Parameters
        ----------
        columns : (m,) bool array
            The rows of B (columns of G).

        Returns
        -------
        (coarse, k) array
            Orthonormal basis of the kernel of the chosen columns' G'.
        """
        # rows of unit length, whatever their weights: what resists is a matter of geometry
        resisted = self.bodies.basis.T @ self.restrict_to_owned(columns)
        lengths = self.constraints.row_lengths[np.flatnonzero(self._owned(columns))]
        resisted = (resisted @ sp.diags(1.0 / lengths)).tocsr()
        gram = self.comm.allreduce((resisted @ resisted.T).toarray()) + self.bodies.energy
        resistance, motions = np.linalg.eigh(gram)
        free: Vector = self.bodies.basis @ motions[:, resistance <= _UNRESISTED]
        return np.linalg.qr(free)[0]


@dataclass(frozen=True)
class Projector:
    """Q and P for the columns of G in a mask (all of them, the equalities, the active rows).

    The coarse matrix is gathered and factored on every rank: it grows with the number of
    subdomains, not of unknowns.

    Attributes
    ----------
    space : CoarseSpace
        G.
    columns : (m,) bool array
        The columns used.
    free : (coarse, k) array
        Orthonormal basis of the kernel of the coarse matrix.
    """

    space: CoarseSpace
    columns: Mask
    free: Vector
    own: sp.csr_matrix
    transposed: sp.csr_matrix
    factor: SparseCholesky | None

    @staticmethod
    def build(space: CoarseSpace, columns: Mask | None = None) -> Projector:
        """Factor the coarse matrix GG' of the chosen columns (default: all)."""
        m = space.own.shape[1]
        columns = np.ones(m, dtype=bool) if columns is None else columns
        select = sp.diags(columns.astype(float), format="csr")
        own, transposed = (space.own @ select).tocsr(), (space.all @ select).T.tocsr()
        free = space.unresisted(columns)
        matrix = _gather_rows(space, (own @ transposed).tocoo())
        if free.shape[1]:
            # no row at all leaves a zero matrix
            matrix = matrix + _pins(free, matrix.diagonal().max() or 1.0)
        factor = SparseCholesky(matrix.tocsr(), space.package) if space.size else None
        return Projector(space, columns, free, own, transposed, factor)

    def coefficients(self, x: Vector) -> Vector:
        """Return (GG')^+ G x for all subdomains; one gathering reduction."""
        part = self.own @ x
        comm = self.space.comm
        return self.solve(part if comm.size == 1 else concatenate_ranks(comm, part))

    def solve(self, coarse: Vector) -> Vector:
        """Return (GG')^+ applied to a coarse vector in the range of G."""
        return coarse if self.factor is None else self.factor.solve(coarse)

    def expand(self, coarse: Vector) -> Vector:
        """Return G' applied to a coarse vector of all subdomains."""
        y: Vector = self.transposed @ coarse
        return y

    def coarse(self, x: Vector) -> Vector:
        """Return Qx = G'(GG')^{-1}Gx."""
        return self.expand(self.coefficients(x))

    def complement(self, x: Vector) -> Vector:
        """Return Px = x - Qx."""
        return x - self.coarse(x)

    def own_part(self, coarse: Vector) -> Vector:
        """Return this rank's part of a coarse vector."""
        return coarse[self.space.first : self.space.first + self.own.shape[0]]


def _gather_rows(space: CoarseSpace, own_rows: sp.coo_matrix) -> sp.csr_matrix:
    entries = [
        concatenate_ranks(space.comm, column)
        for column in (own_rows.row + space.first, own_rows.col, own_rows.data)
    ]
    return sp.csr_matrix((entries[2], (entries[0], entries[1])), shape=(space.size, space.size))


def _pins(free: Vector, stiffness: float) -> sp.csr_matrix:
    """Return a diagonal that pins one coarse unknown for each free motion.

    The sum with the coarse matrix is definite, and for right-hand sides without a part in `free`
    the pinned unknowns are zero: its inverse is a generalised inverse of the coarse matrix.
    """
    pivots = qr(free.T, mode="economic", pivoting=True)[2][: free.shape[1]]
    diagonal = np.zeros(free.shape[0])
    diagonal[pivots] = stiffness
    return sp.diags(diagonal, format="csr")


def _body_motions(system: TornSystem, kernels: Sequence[Vector]) -> BodyMotions:
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
        block = sp.lil_matrix((inside.shape[0], modes * bodies))
        block[:, body * modes : (body + 1) * modes] = inside @ inverse[body]
        rows.append(block.tocsr())
    basis = sp.vstack(comm.allgather(sp.vstack(rows, format="csr")), format="csr")
    scaled = [t.T @ e @ t for t, e in zip(inverse, energy, strict=True)]
    # rounding leaves traces of 1e-16 in what should vanish
    scaled = [np.where(np.abs(e) > _UNRESISTED, e, 0.0) for e in scaled]
    return BodyMotions(basis, block_diag(*scaled) if bodies else np.zeros((0, 0)))


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
