"""The inverse of F on a face, by a sparse factor of all bodies joined along the face.

The preconditioners close the gaps of a face by displacements that hold the rest of the contact
surfaces. Bodies that bend, such as stacked leaf springs, would rather bend than be squeezed: there
the condition number is the ratio of the two stiffnesses, 10^5 and more. With the stiffness matrices
K of the subdomains, the rows B of a face and a compliance D of the rows,

    (B K^+ B' + D)^{-1} = D^{-1} - D^{-1} B (K + B'D^{-1}B)^{-1} B'D^{-1},

which is exact but for a D that is small beside F; curvature of friction, springs and the proximal
term are in D, too. A factor for each face pays where conjugate gradients have been slow. All ranks
have it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky
from fenics_tfeti.feti.local.congruence import of_subdomains
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Numbers, Operator, Vector

# unknowns of all subdomains that each rank factors for each face
_MOST = 50_000
# a factorization takes the time of 40 steps of conjugate gradients, measured with subdomains of 600
# to 50,000 unknowns in three dimensions
_STEPS = 40
# D of all rows, relative to F of a row: small, and no smaller than rounding needs
_COMPLIANCE = 1e-3
# stiffness added at all nodes, relative to their own, for bodies that no row of the face holds
_SUPPORT = 1e-10


@dataclass
class DirectFaces:
    """Direct solvers of faces, which keep the factor of the last one."""

    F: DualOperator
    stiffness: Sequence[sp.csr_matrix]  # (n, n): K_i of each subdomain of this rank
    unit: float  # stiffness that a weight of 1 stands for [N/m]
    package: str  # of the factors
    # steps on a face that take the time of a factor; infinite without direct solvers
    patience: float
    _last: tuple[sp.csr_matrix, Vector, Callable[[Vector], Vector]] | None = field(
        init=False, repr=False, default=None
    )

    _of_all: _Joined | None = field(init=False, repr=False, default=None)

    @staticmethod
    def build(
        F: DualOperator, stiffness: Sequence[sp.csr_matrix], unit: float, package: str
    ) -> DirectFaces:
        """Make them for the subdomains of all ranks. Collective.

        The time for a factor of all subdomains grows with the 4/3rd power of their number beside
        that of a step, as measured.
        """
        own = of_subdomains(F.interface.classes, stiffness)
        counts = np.array([len(own), sum(K.shape[0] for K in own)])
        F.constraints.layout.comm.Allreduce(MPI.IN_PLACE, counts)
        number, unknowns = counts.tolist()
        patience = _STEPS * number ** (1 / 3) if unknowns <= _MOST else np.inf
        return DirectFaces(F, own, unit, package, patience)

    def on(self, face: Face) -> Operator:
        """Return x -> this rank's part of the inverse of F + C, x zero off the face. Collective."""
        joined = self._join()
        C, D = joined.combinations(face)
        D += _COMPLIANCE / self.unit
        if self._last is None or not _equal(self._last[:2], (C, D)):
            self._last = C, D, self._inverse(joined, C, D)
        inverse = self._last[2]
        return lambda x: joined.part(inverse(joined.gather(x)))

    def _inverse(self, joined: _Joined, C: sp.csr_matrix, D: Vector) -> Callable[[Vector], Vector]:
        """Factor K + B'D^{-1}B of a face."""
        B, K = (C @ joined.B).tocsr(), joined.stiffness
        support = K.diagonal()
        support[support == 0.0] = support.max()  # of rigid bodies
        A = K + B.T @ sp.diags(1.0 / D) @ B + _SUPPORT * sp.diags(support)
        factor = sparse_cholesky(A.tocsr(), self.package)

        def solve(x: Vector) -> Vector:
            y = (C @ x) / D
            y -= (B @ factor.solve(B.T @ y)) / D
            return C.T @ y

        return solve

    def _join(self) -> _Joined:
        """Return K and B, gathered. Collective at first."""
        if self._of_all is None:
            self._of_all = self._gathered()
        return self._of_all

    def _gathered(self) -> _Joined:
        F, comm = self.F, self.F.constraints.layout.comm
        unknowns = of_subdomains(F.interface.classes, F.interface.unknowns)
        sizes = [K.shape[0] for K in self.stiffness]
        first, number = first_of_rank(comm, sum(sizes))
        starts = first + np.cumsum([0, *sizes])[:-1]
        place = [begin + local for begin, local in zip(starts, unknowns, strict=True)]
        layout = F.constraints.layout
        every = np.sort(concatenate_ranks(comm, layout.numbers[: layout.owned]))
        positions, entries = np.searchsorted(every, layout.numbers), F.interface.matrix.tocoo()
        columns = np.concatenate([np.zeros(0, dtype=np.int64), *place])[entries.col]
        shape = every.size, number
        part = sp.csr_matrix((entries.data, (positions[entries.row], columns)), shape)
        B = sum(comm.allgather(part), sp.csr_matrix(shape))
        blocks = [K for own in comm.allgather(self.stiffness) for K in own]
        K = sp.block_diag(blocks, format="csr")
        return _Joined(F.constraints, K, B.tocsr(), positions)


@dataclass(frozen=True)
class _Joined:
    """K and B of all subdomains; the same on all ranks but for the positions."""

    constraints: Constraints
    stiffness: sp.csr_matrix  # (n, n): K
    B: sp.csr_matrix  # (r, n)
    positions: Numbers  # (m,): where this rank's rows are among the r rows

    def gather(self, x: Vector) -> Vector:
        """Return the rows (r,) of a vector (m,). Collective."""
        layout, whole = self.constraints.layout, np.zeros(self.B.shape[0])
        whole[self.positions[: layout.owned]] = x[: layout.owned]
        layout.comm.Allreduce(MPI.IN_PLACE, whole)
        return whole

    def part(self, whole: Vector) -> Vector:
        """Return the rows that this rank owns, in a vector (m,)."""
        return self.constraints.layout.owned_part(whole[self.positions])

    def combinations(self, face: Face) -> tuple[sp.csr_matrix, Vector]:
        """Return E (f, r) of a face, and C of each of its combinations. Collective."""
        constraints, layout = self.constraints, self.constraints.layout
        chosen = np.flatnonzero(face.rows[: layout.owned])
        combinations = [sp.identity(constraints.size, format="csr")[chosen]]
        compliance = face.compliance
        compliances = [np.zeros(chosen.size) if compliance is None else compliance[chosen]]
        combined = face.combinations()
        if combined is not None:
            turning = constraints.owned_sites & face.turning
            combinations.append(combined[np.flatnonzero(turning)])
            compliances.append(face.proximal_compliance + face.curvature[turning])
        entries = sp.vstack(combinations).tocoo()
        shape = entries.shape[0], self.B.shape[0]
        part = sp.csr_matrix((entries.data, (entries.row, self.positions[entries.col])), shape)
        whole = sp.vstack(layout.comm.allgather(part), format="csr")
        return whole, concatenate_ranks(layout.comm, np.concatenate(compliances))


def _equal(face: tuple[sp.csr_matrix, Vector], other: tuple[sp.csr_matrix, Vector]) -> bool:
    """Tell whether two faces have the same combinations of rows, and the same C."""
    (A, D), (B, E) = face, other
    if A.shape != B.shape or not np.allclose(D, E, rtol=ZERO, atol=0.0):
        return False
    return bool(abs(A - B).max() <= ZERO) if A.nnz or B.nnz else True
