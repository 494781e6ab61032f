"""GG' of the rows of a face, and its generalized inverse.

Motions that the rows do not resist are pinned in the matrix A = GG' + pins that is factored: for
right-hand sides without a part in them the pinned unknowns are zero, and A^{-1} is a generalized
inverse of GG'.

GG', which squares G, does not show motions that the rows resist weakly either. They are pinned,
too, and return as a correction: (GG')^+ = A^{-1} + ZZ' and Q = G'A^{-1}G + WW' with W = G'Z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.column_groups import pivot_rows
from fenics_tfeti.feti.coarse.factor import CoarseFactor
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.tolerances import WEAK, rounding
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class GramInverse:
    """(GG')^+ of the rows of a face: a factor, and what it lacks of weakly resisted motions."""

    layout: DualLayout
    factor: CoarseFactor  # of A
    motions: Vector  # Z (coarse, k); k = 0 where the rows resist no motion weakly
    rows: Vector  # W (m, k) on all rows held; orthonormal on the rows of the face

    @staticmethod
    def build(
        coarse_space: CoarseSpace,
        face: Face,
        free: sp.csr_matrix,
        single: int,
        weak: sp.csr_matrix,
    ) -> GramInverse:
        """Factor A of a face and correct its inverse. Collective.

        Free are motions (coarse, k), the first of them of a single body, weak are
        z (modes * bodies, n) of `BodyMotions`.
        """
        layout, columns = coarse_space.layout, coarse_space.columns(face)
        gram = coarse_space.equality + layout.rows((columns[layout.own] @ columns.T).tocsr())
        pins = _pins(coarse_space, gram, free, single, weak)
        factor = layout.factor(layout.add_to_diagonal(gram, pins))
        dual_layout = coarse_space.constraints.layout
        none = np.zeros((layout.size, 0)), np.zeros((dual_layout.numbers.size, 0))
        inverse = GramInverse(dual_layout, factor, *none)
        if not weak.shape[1]:
            return inverse
        return inverse._corrected(coarse_space, face, weak.toarray())

    def _corrected(self, coarse_space: CoarseSpace, face: Face, weak: Vector) -> GramInverse:
        """Return A^{-1} with its correction for weakly resisted motions, which A pins."""
        restrict, owned = coarse_space.restrict, self.layout.owned
        # Z = (I - A^{-1} GG') T z, W = G'Z; what T z does to the rows is known without rounding
        moved = coarse_space.moved_rows(weak)
        follow = np.column_stack([self.factor.solve(restrict(face.part(x))) for x in moved.T])
        W = moved - np.column_stack([coarse_space.prolong(column) for column in follow.T])
        on_face = np.column_stack([face.part(column) for column in W.T])[:owned]
        # Z and W times V S^{-1/2} with W'W = VSV'; motions that only springs resist move no row
        squares, V = np.linalg.eigh(self.layout.space.sum_over_ranks(on_face.T @ on_face))
        moving = squares > rounding(squares.max(initial=0.0))
        normalize = V[:, moving] / np.sqrt(squares[moving])
        Z = (coarse_space.coarse_motions(weak) - follow) @ normalize
        return replace(self, motions=Z, rows=W @ normalize)

    def weak_part(self, x: Vector) -> Vector:
        """Return W'x for a vector on the rows; one reduction, if there are such motions."""
        part: Vector = self.rows[: self.layout.owned].T @ x[: self.layout.owned]
        return self.layout.space.sum_over_ranks(part) if part.size else part


def _pins(
    coarse_space: CoarseSpace,
    gram: sp.csr_matrix,
    free: sp.csr_matrix,
    single: int,
    weak: sp.csr_matrix,
) -> Vector:
    """Return what is added to the diagonal of GG' for motions that are resisted too little.

    Weak motions are pinned so firmly that what resists them, the square of `WEAK` at most, is
    rounding beside the pin. That is relative to rows that resist fully: perhaps no row of GG' does.
    """
    added = np.zeros(coarse_space.layout.size)
    if free.shape[1] + weak.shape[1]:
        largest: float = coarse_space.layout.largest_diagonal(gram)
        row: float = coarse_space.find_longest_row() ** 2
        pin = max(largest, rounding(row)) or 1.0
        if weak.shape[1]:
            pin = max(largest, row) / WEAK**2
        several = sp.hstack([free[:, single:], coarse_space.coarse_motions(weak)], format="csr")
        added[pivot_rows(free[:, :single], several)] = pin
    return added
