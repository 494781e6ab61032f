"""The inverse of F on a face, by a sparse factor of the bodies in contact joined along the face.

The preconditioners close the gaps of a face by displacements that hold the rest of the contact
surfaces. Bodies that bend, such as stacked leaf springs, would rather bend than be squeezed: there
the condition number is the ratio of the two stiffnesses, 10^5 and more. With the stiffness matrices
K of the subdomains in contact, the rows B of a face between them and a compliance D of the rows,

    (B K^+ B' + D)^{-1} = D^{-1} - D^{-1} B (K + B'D^{-1}B)^{-1} B'D^{-1},

which is exact but for a D that is small beside F; curvature of friction and the proximal term are
in D, too. A factor for each face pays where conjugate gradients have been slow. All ranks have it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.factors.cholesky import SparseCholesky
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Numbers, Operator, Vector

# unknowns of the subdomains in contact, of all ranks, that each rank factors for each face
_MOST = 50_000
# steps of conjugate gradients that take the time of a factor, measured with subdomains of 600 to
# 50,000 unknowns in three dimensions: a solve is an eightieth of it, a step some of them
_STEPS = 40
# D of all rows, relative to F of a row: small, and no smaller than rounding needs
_COMPLIANCE = 1e-3
# stiffness of what no row of the face holds, relative to that of nodes
_SUPPORT = 1e-11


@dataclass
class DirectFaces:
    """Direct solvers of faces, from the first one on that converges slowly."""

    F: DualOperator
    stiffness: Sequence[sp.csr_matrix]  # (n, n): K_i of each class
    unit: float  # stiffness that a weight of 1 stands for [N/m]
    package: str  # of the factors
    slow: bool = field(init=False, default=False)  # whether conjugate gradients were slow on a face
    _last: tuple[sp.csr_matrix, Vector, Callable[[Vector], Vector]] | None = field(
        init=False, repr=False, default=None
    )

    @cached_property
    def patience(self) -> float:
        """Number of steps on a face that take the time of a factor, infinite without. Collective.

        A step solves for all subdomains. The time for a factor of the joined ones grows with the
        4/3rd power of their number, as measured.
        """
        sizes = [self.stiffness[c].shape[0] for c in self._column]
        joined = [sizes[i] for i in self._members]
        counts = np.array([sum(sizes), sum(joined), len(joined)], dtype=float)
        self.F.constraints.layout.comm.Allreduce(MPI.IN_PLACE, counts)
        every, unknowns, number = counts
        if not 0 < unknowns <= _MOST:
            return np.inf
        return float(_STEPS * number ** (1 / 3) * unknowns / every)

    def on_face(
        self, projector: Projector, curvature: Vector, compliance: float, others: Operator
    ) -> Operator:
        """Return x -> this rank's part of the inverse of F + C, x zero off the face. Collective.

        `curvature` (k,) of forces that turn and the `compliance` of rows with bounds are those of
        C. The operator `others` stands for rows that are not between the subdomains in contact.
        """
        group = self._group
        C, D = group.face(projector, curvature, compliance)
        D += _COMPLIANCE / self.unit
        if self._last is None or not _equal(self._last[:2], (C, D)):
            self._last = C, D, self._inverse(group, C, D)
        inverse = self._last[2]

        def apply(x: Vector) -> Vector:
            own = group.gather(x)
            x = x.copy()
            x[group.rows] = 0.0
            part = others(x)
            part[group.rows] = 0.0
            part[group.rows[group.owned]] = inverse(own)[group.positions[group.owned]]
            return part

        return apply

    def _inverse(self, group: _Group, C: sp.csr_matrix, D: Vector) -> Callable[[Vector], Vector]:
        """Factor K + B'D^{-1}B of a face."""
        B, K = (C @ group.rows_of_B).tocsr(), group.stiffness
        joined = K + B.T @ sp.diags(1.0 / D) @ B + _SUPPORT * sp.diags(K.diagonal())
        factor = SparseCholesky(joined.tocsr(), self.package)

        def solve(x: Vector) -> Vector:
            y = (C @ x) / D
            y -= (B @ factor.solve(B.T @ y)) / D
            on_rows: Vector = C.T @ y
            return on_rows

        return solve

    @cached_property
    def _column(self) -> Numbers:
        """The class of each subdomain of this rank."""
        classes = self.F.interface.classes
        return np.repeat(np.arange(len(classes)), [c.members.size for c in classes])

    @cached_property
    def _members(self) -> list[int]:
        """The subdomains of this rank that are in contact."""
        interface, equality = self.F.interface, self.F.constraints.equality
        touched = np.zeros(interface.columns.size, dtype=bool)
        touched[interface.matrix[np.flatnonzero(~equality)].indices] = True
        ends = interface.ends
        return [i for i in range(len(ends) - 1) if touched[ends[i] : ends[i + 1]].any()]

    @cached_property
    def _group(self) -> _Group:
        """The subdomains in contact. Collective."""
        interface = self.F.interface
        own = [self.stiffness[self._column[i]] for i in self._members]
        sizes = [K.shape[0] for K in own]
        first, unknowns = first_of_rank(self.F.constraints.layout.comm, sum(sizes))
        # the group's number of each packed unknown; -1 of others
        place = np.full(interface.columns.size, -1, dtype=np.int64)
        for i, begin in zip(self._members, first + np.cumsum([0, *sizes])[:-1], strict=True):
            part = slice(*interface.ends[i : i + 2])
            place[part] = begin + interface.unknowns[self._column[i]]
        return _Group.build(self.F, own, place, unknowns)


@dataclass(frozen=True)
class _Group:
    """Subdomains in contact, with the rows that are between them alone; the same on all ranks."""

    F: DualOperator
    stiffness: sp.csr_matrix  # (n, n): K
    rows_of_B: sp.csr_matrix  # (r, n)
    rows: Numbers  # (h,): local positions of the rows that this rank holds
    positions: Numbers  # (h,): their numbers among the r rows
    owned: Numbers  # those of `rows` that this rank owns

    @staticmethod
    def build(
        F: DualOperator, own: Sequence[sp.csr_matrix], place: Numbers, unknowns: int
    ) -> _Group:
        """Gather K and B, from this rank's K_i and the numbers of its packed unknowns. Collective.

        Unknowns of other subdomains have the number -1.
        """
        layout, comm = F.constraints.layout, F.constraints.layout.comm
        entries = F.interface.matrix.tocoo()
        filled = entries.data != 0.0
        inside = place[entries.col] >= 0
        beside = np.bincount(entries.row[filled & ~inside], minlength=entries.shape[0])
        within = np.bincount(entries.row[filled & inside], minlength=entries.shape[0])
        beside, within = layout.sum(np.column_stack([beside, within]).astype(float)).T
        rows = np.flatnonzero((beside == 0.0) & (within > 0.0))
        owned = np.flatnonzero(rows < layout.owned)
        numbers = np.sort(concatenate_ranks(comm, layout.numbers[rows[owned]]))
        positions = np.searchsorted(numbers, layout.numbers[rows])
        position = np.full(entries.shape[0], -1, dtype=np.int64)
        position[rows] = positions
        kept = filled & (position[entries.row] >= 0)
        part = sp.csr_matrix(
            (entries.data[kept], (position[entries.row[kept]], place[entries.col[kept]])),
            (numbers.size, unknowns),
        )
        B = sum(comm.allgather(part), sp.csr_matrix(part.shape))
        blocks = [K for ranks in comm.allgather(list(own)) for K in ranks]
        K = sp.block_diag(blocks, format="csr")
        return _Group(F, K, B.tocsr(), rows, positions, owned)

    def gather(self, x: Vector) -> Vector:
        """Return the rows (r,) of a vector (m,). Collective."""
        whole = np.zeros(self.rows_of_B.shape[0])
        whole[self.positions[self.owned]] = x[self.rows[self.owned]]
        comm = self.F.constraints.layout.comm
        if comm.size > 1:
            comm.Allreduce(MPI.IN_PLACE, whole)
        return whole

    def face(
        self, projector: Projector, curvature: Vector, compliance: float
    ) -> tuple[sp.csr_matrix, Vector]:
        """Return the orthonormal combinations (f, r) of rows on a face, and C of each. Collective.

        They are rows, and the combinations across the forces of sites that slip.
        """
        constraints = self.F.constraints
        friction, layout, size = constraints.friction, constraints.layout, constraints.size
        position = np.full(size, -1, dtype=np.int64)
        position[self.rows] = self.positions
        chosen = self.rows[self.owned]
        chosen = chosen[projector.rows[chosen]]
        combinations = [sp.identity(size, format="csr")[chosen]]
        compliances = [np.where(constraints.equality[chosen], 0.0, compliance)]
        if projector.across is not None:
            turning = friction.owned(layout.owned) & projector.across.any(axis=1)
            turning &= position[friction.rows.max(axis=1, initial=0)] >= 0
            combinations.append(friction.combined(projector.across, size)[np.flatnonzero(turning)])
            compliances.append(compliance + curvature[turning])
        entries = sp.vstack(combinations).tocoo()
        shape = entries.shape[0], self.rows_of_B.shape[0]
        part = sp.csr_matrix((entries.data, (entries.row, position[entries.col])), shape)
        whole = sp.vstack(layout.comm.allgather(part), format="csr")
        return whole, concatenate_ranks(layout.comm, np.concatenate(compliances))


def _equal(face: tuple[sp.csr_matrix, Vector], other: tuple[sp.csr_matrix, Vector]) -> bool:
    """Tell whether two faces have the same combinations of rows, and the same C."""
    (A, D), (B, E) = face, other
    if A.shape != B.shape or not np.allclose(D, E, rtol=ZERO, atol=0.0):
        return False
    return bool(abs(A - B).max() <= ZERO) if A.nnz or B.nnz else True
