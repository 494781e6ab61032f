"""Deluxe scaling of stiff modes: B_D with the weights D + sum theta f f' in place of D.

S is approximated by D but for the stiff modes f = Dv of nearly incompressible subdomains
(`stiff_modes`), where S = theta D. With these weights the jump at an interface is closed by
displacements that change no volume, wherever one of its sides can follow. If neither can, F is as
small as the Dirichlet preconditioner is large. With V of the columns v sqrt(theta / (1 + theta)),
normalised by v'Dv = 1, and C = BV,

    (D + sum theta f f')^{-1} = D^{-1} - VV',
    B (D + ..)^{-1} B' = W - CC',    (W - CC')^{-1} = W^{-1} + W^{-1} C A^{-1} C' W^{-1},

A = I - C' W^{-1} C, all of it on the rows of the face. A is sparse: modes of subdomains that share
no row have a zero there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.coupling import RowInverse
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.deflation.stiff_modes import StiffModes
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky
from fenics_tfeti.feti.local.congruence import of_subdomains
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Mask, Operator, Vector


@dataclass(frozen=True)
class DeluxeScaling:
    """The low-rank part of the weights, and of the Gram matrix of rows; k modes of all ranks."""

    F: DualOperator
    flexibility: Vector  # (b,): D^{-1}, relative to the unit
    modes: list[Vector]  # V of each class (b, j), on its interface unknowns
    first: int  # position of this rank's first mode
    count: int  # modes of this rank
    coupled: sp.csr_matrix  # (w, k): C of the coupled rows
    others: sp.csr_matrix  # (m, k): C of the uncoupled inequality rows that this rank owns
    gram: sp.csr_matrix  # (k, k): I - C'C of the uncoupled equality rows
    package: str  # of the factors

    @staticmethod
    def build(
        F: DualOperator, modes: Sequence[StiffModes | None], unit: float, package: str
    ) -> DeluxeScaling | None:
        """Make C and C'C; None, on all ranks, if there are no modes. Collective.

        The modes are those of each class; unit is the stiffness of a weight of 1 [N/m].
        """
        interface, constraints = F.interface, F.constraints
        V = [
            np.zeros((unknowns.size, 0)) if stiff is None else _columns(stiff, unit)
            for stiff, unknowns in zip(modes, interface.unknowns, strict=True)
        ]
        blocks = of_subdomains(interface.classes, [sp.csr_matrix(v) for v in V])
        count = sum(block.shape[1] for block in blocks)
        first, total = first_of_rank(constraints.layout.comm, count)
        if not total:
            return None
        whole = sp.block_diag([sp.csr_matrix((0, 0)), *blocks], format="csr")
        entries = (interface.matrix @ whole).tocoo()
        # columns of C are of length 1 at most
        kept = np.abs(entries.data) > ZERO
        places = (entries.row[kept], entries.col[kept] + first)
        own = sp.csr_matrix((entries.data[kept], places), (constraints.size, total))
        C = constraints.layout.sum_sparse(own)
        coupled, others, gram = _of_rows(constraints, C)
        flexibility = 1.0 / constraints.weights[interface.columns]
        return DeluxeScaling(F, flexibility, V, first, count, coupled, others, gram, package)

    @property
    def size(self) -> int:
        """Modes of all ranks."""
        return int(self.gram.shape[0])

    def displacements(self, forces: Vector) -> Vector:
        """Return (D + ..)^{-1} times packed forces on the interface."""
        blocks = self.F.interface.blocks(forces)
        low_rank = [(x @ V) @ V.T for x, V in zip(blocks, self.modes, strict=True)]
        return self.flexibility * forces - self.F.interface.pack(low_rank)

    def on_face(self, rows: Mask, inverse: RowInverse) -> Operator:
        """Return x -> (W - CC')_RR^{-1} x, zero off the face. Collective.

        The mask `rows` (m,) is that of the face R, and the inverse is W_RR^{-1} of coupled rows. x
        and the result are on all rows of this rank, equal on all ranks.
        """
        layout, coupling = self.F.constraints.layout, self.F.constraints.coupling
        part = self.others[np.flatnonzero(rows[: layout.owned])]
        A = self.gram - layout.comm.allreduce((part.T @ part).tocsr())
        factor = sparse_cholesky((A - _weighted_gram(self.coupled, inverse)).tocsr(), self.package)

        def of_uncoupled(x: Vector) -> Vector:
            x = np.where(rows, x, 0.0)
            x[coupling.rows] = inverse.solve(coupling.gather(x)[0])[coupling.positions]
            return x

        def solve(x: Vector) -> Vector:
            sizes = concatenate_ranks(layout.comm, self._sizes(of_uncoupled(x)))
            own = factor.solve(sizes)[self.first : self.first + self.count]
            return of_uncoupled(x + layout.sum(self._rows(own)))

        return solve

    def _sizes(self, x: Vector) -> Vector:
        """Return C'x of this rank's modes."""
        blocks = self.F.interface.blocks(self.F.interface.transposed @ x)
        parts = [(f @ V).ravel() for f, V in zip(blocks, self.modes, strict=True)]
        return np.concatenate([np.zeros(0), *parts])

    def _rows(self, sizes: Vector) -> Vector:
        """Return C times sizes of this rank's modes."""
        interface, blocks, end = self.F.interface, list[Vector](), 0
        for congruent, V in zip(interface.classes, self.modes, strict=True):
            begin, end = end, end + congruent.members.size * V.shape[1]
            blocks.append(sizes[begin:end].reshape(congruent.members.size, V.shape[1]) @ V.T)
        return interface.matrix @ interface.pack(blocks)


def _columns(stiff: StiffModes, unit: float) -> Vector:
    """Return V (b, j) of a class."""
    size = np.sqrt(unit * stiff.values / (1.0 + stiff.values))
    return stiff.vectors * size / stiff.root[:, None]


def _of_rows(
    constraints: Constraints, C: sp.csr_matrix
) -> tuple[sp.csr_matrix, sp.csr_matrix, sp.csr_matrix]:
    """Return C of coupled rows on all ranks, of other inequalities, and I - C'C. Collective."""
    layout, coupling = constraints.layout, constraints.coupling
    owned = coupling.owned
    own = sp.csr_matrix(
        (np.ones(owned.sum()), (coupling.positions[owned], coupling.rows[owned])),
        (coupling.numbers.size, C.shape[0]),
    )
    coupled = layout.comm.allreduce((own @ C).tocsr())
    uncoupled = np.arange(C.shape[0]) < layout.owned
    uncoupled[coupling.rows] = False
    equality = C[np.flatnonzero(uncoupled & constraints.equality)]
    gram = sp.identity(C.shape[1], format="csr")
    gram = gram - layout.comm.allreduce((equality.T @ equality).tocsr())
    others = sp.diags((uncoupled & ~constraints.equality).astype(float)) @ C
    return coupled, others.tocsr(), gram


def _weighted_gram(C: sp.csr_matrix, inverse: RowInverse) -> sp.csr_matrix:
    """Return C'W^{-1}C of the coupled rows."""
    k = C.shape[1]
    used = np.flatnonzero(C[np.flatnonzero(inverse.chosen)].getnnz(axis=0))
    dense = C[:, used].toarray()
    solved = np.zeros(dense.T.shape)
    for position, column in enumerate(dense.T):
        solved[position] = inverse.solve(column)
    places = (np.repeat(used, used.size), np.tile(used, used.size))
    return sp.csr_matrix(((solved @ dense).ravel(), places), (k, k))
