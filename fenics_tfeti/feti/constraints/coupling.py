"""W in B D^{-1} B' = blockdiag(I, W): rows that are not orthogonal to all others, and W_RR^+.

All rows of a mortar share master nodes, so W is sparse and may have one large block for a pair of
surfaces. Every rank has all of W, and factors the part W_RR of the rows R that are constraints of
the problem at hand. Entries of the inverse of all of W are no inverse of W_RR.

Rows may depend linearly on others: more contacts at a node than it has components, or more slave
nodes with prescribed displacements than master nodes. The null vectors of W reach over few rows;
these are found once, by small pivots of a factor of W, and treated by dense algebra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.costs import COLUMNS
from fenics_tfeti.feti.tolerances import GIVEN, PARALLEL, WEAK, ZERO, rounding
from fenics_tfeti.typing import Mask, Numbers, Vector

# pivot of a matrix with a diagonal of 1 below which its row may depend on the rows before, and what
# is added to the diagonal so that no pivot vanishes
_SMALL_PIVOT, _SHIFT = 1e-6, rounding(1.0, GIVEN)


@dataclass(frozen=True)
class Coupling:
    """Tied and contact rows that are not orthogonal to all others.

    All other rows, and rows of different blocks of W, are orthonormal. `numbers`, `gram`, `kind`
    and `tolerance` are the same on all ranks.
    """

    numbers: Numbers  # (w,): global numbers of the coupled rows, ascending
    # (w, w): W; its diagonal is 1, or less for tangential rows; it may be singular
    gram: sp.csr_matrix
    rigid: sp.csr_matrix  # (w, q): what the rows do to motions of rigid bodies, which W has not
    kind: Numbers  # (w,): `Kind`
    tolerance: Vector  # (w,): rounding of right-hand sides
    rows: Numbers  # (h,): local positions of the coupled rows that this rank holds
    positions: Numbers  # (h,): their positions in `numbers`
    owned: Mask  # (h,): which of them this rank owns
    comm: MPI.Intracomm
    _last: list[RowInverse] = field(default_factory=list, init=False, repr=False, compare=False)

    @property
    def tied(self) -> Mask:
        """Tied rows (w,)."""
        return np.asarray(self.kind == Kind.TIED)

    @property
    def tangential(self) -> Mask:
        """Tangential rows of friction (w,)."""
        return np.asarray(self.kind == Kind.TANGENT)

    @cached_property
    def groups(self) -> list[Numbers]:
        """Positions of rows that depend linearly on each other, group by group."""
        return dependent_groups(self.gram, self.rigid)

    @cached_property
    def clusters(self) -> list[list[Numbers]]:
        """The groups by the rigid bodies that their rows act on: those of a cluster share some."""
        members = [sp.csr_matrix(abs(self.rigid[rows]).sum(axis=0)) for rows in self.groups]
        bodies = sp.vstack([sp.csr_matrix((0, self.rigid.shape[1])), *members])
        number, cluster = connected_components(bodies @ bodies.T, directed=False)
        return [[self.groups[g] for g in np.flatnonzero(cluster == k)] for k in range(number)]

    @cached_property
    def dependent(self) -> int:
        """Number of coupled rows less the rank of B there."""
        number = 0
        for cluster in self.clusters:
            null, on_bodies = zip(*map(self.vanishing, cluster), strict=True)
            number += sum(n.shape[1] for n in null) - rank(np.hstack(on_bodies))
        return number

    def vanishing(self, rows: Numbers) -> tuple[Vector, Vector]:
        """Return combinations of some rows (k,) of a group that vanish but at rigid bodies.

        They are an orthonormal basis N (k, n), and what it does to motions of the bodies (q, n).
        """
        null = _vanishing(self.gram, self.rigid, rows)
        return null, self.rigid[rows].T @ null

    def whole_gram(self, rows: Numbers) -> Vector:
        """Return a Gram matrix (k, k) of some rows with all terms, those at rigid bodies too."""
        rigid = _on_bodies(self.rigid, rows)
        return _block(self.gram, rows) + rigid @ rigid.T

    @cached_property
    def block(self) -> Numbers:
        """The diagonal block of W that each row belongs to, (w,)."""
        return connected_components(self.gram, directed=False)[1].astype(np.int64)

    @cached_property
    def _owned_rows(self) -> Numbers:
        return self.rows[self.owned]

    @cached_property
    def _owned_positions(self) -> Numbers:
        return self.positions[self.owned]

    def gather(self, *local: Vector) -> Vector:
        """Return the coupled rows of vectors (m,), (k, w), the same on all ranks. Collective."""
        owned = self._owned_rows
        coupled = np.zeros((len(local), self.numbers.size))
        coupled[:, self._owned_positions] = [x[owned] for x in local]
        self._sum_over_ranks(coupled)
        return coupled

    def sum(self, part: Vector) -> Vector:
        """Return the coupled rows (w,) of the sum of the ranks' parts (m,). Collective."""
        coupled = np.zeros(self.numbers.size)
        coupled[self.positions] = part[self.rows]
        self._sum_over_ranks(coupled)
        return coupled

    def _sum_over_ranks(self, coupled: Vector) -> None:
        if self.comm.size > 1:
            self.comm.Allreduce(MPI.IN_PLACE, coupled)

    def inverse(self, chosen: Mask) -> RowInverse:
        """Return W_RR^+ of the chosen rows (w,): the last one, unless R has changed."""
        if not (self._last and np.array_equal(self._last[0].chosen, chosen)):
            self._last[:] = [RowInverse.build(self.gram, chosen, self.groups, self.rigid)]
        return self._last[0]


@dataclass(frozen=True)
class RowInverse:
    """W_RR^+ = (I - N N') W_RR^- (I - N N'), with W_RR^- of independent rows and null vectors N."""

    chosen: Mask  # (w,): R
    independent: Numbers  # (r,): positions of rows on which all others of R depend
    null: sp.csr_matrix  # (w, k): N, an orthonormal basis of the kernel of W_RR
    _factor: SuperLU | None = field(repr=False)

    @staticmethod
    def build(
        W: sp.csr_matrix,
        chosen: Mask,
        groups: Sequence[Numbers] = (),
        rigid: sp.csr_matrix | None = None,
    ) -> RowInverse:
        """Factor W_RR.

        W is positive semidefinite with a diagonal of 1; the groups are its `dependent_groups` with
        the same `rigid`.

        Examples
        --------
        >>> W = sp.csr_matrix(np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
        >>> inverse = RowInverse.build(W, np.array([True] * 3), dependent_groups(W))
        >>> inverse.solve(np.array([1.0, 1.0, 2.0])).round(12).tolist()
        [0.5, 0.5, 2.0]
        """
        independent, number = chosen.copy(), 0
        row, column, data = [np.zeros(0, dtype=int)], [np.zeros(0, dtype=int)], [np.zeros(0)]
        for members in groups:
            rows_of_group = members[chosen[members]]
            null = _vanishing(W, rigid, rows_of_group)
            if null.shape[1]:
                # rows without which the others are independent
                pivots = qr(null.T, mode="r", pivoting=True)[1][: null.shape[1]]
                independent[rows_of_group[pivots]] = False
                row.append(np.repeat(rows_of_group, null.shape[1]))
                column.append(np.tile(number + np.arange(null.shape[1]), rows_of_group.size))
                data.append(null.ravel())
                number += null.shape[1]
        rows = np.flatnonzero(independent)
        factor = _factor(W[rows][:, rows]) if rows.size else None
        where = (np.concatenate(row), np.concatenate(column))
        N = sp.csr_matrix((np.concatenate(data), where), (chosen.size, number))
        return RowInverse(chosen, rows, N, factor)

    def solve(self, b: Vector) -> Vector:
        """Return W_RR^+ b_R as a vector (w,), zero outside R."""
        y = np.zeros(self.chosen.size)
        if self._factor is not None:
            b = self._without_null(np.where(self.chosen, b, 0.0))
            y[self.independent] = self._factor.solve(b[self.independent])
            y = self._without_null(y)
        return y

    def _without_null(self, x: Vector) -> Vector:
        if not self.null.shape[1]:
            return x
        return x - self.null @ (self.null.T @ x)


def dependent_groups(W: sp.csr_matrix, rigid: sp.csr_matrix | None = None) -> list[Numbers]:
    """Return groups of rows that contain the null vectors of W: each has some, and all have all.

    W is positive semidefinite with a diagonal of 1; `rigid` (w, q) is what the rows do to motions
    of rigid bodies, beside which combinations of rows may vanish (`null_space`).

    Examples
    --------
    >>> W = np.identity(4)
    >>> W[1, 3] = W[3, 1] = 1.0
    >>> [rows.tolist() for rows in dependent_groups(sp.csr_matrix(W))]
    [[1, 3]]
    """
    w = W.shape[0]
    if w == 0:
        return []
    factor = _factor(W + _SHIFT * sp.identity(w, format="csr"))
    small = factor.U.diagonal()[factor.perm_r] <= _SMALL_PIVOT
    candidates, regular = np.flatnonzero(small), np.flatnonzero(~small)
    if not candidates.size:
        return []
    # a null vector n of W is -W_II^{-1} W_ID n_D on the independent rows I
    reached = small.copy()
    if regular.size:
        factor = _factor(W[regular][:, regular])
        right = W[regular][:, candidates]
        for start in range(0, candidates.size, COLUMNS):
            columns = factor.solve(right[:, start : start + COLUMNS].toarray())
            reached[regular] |= np.abs(columns).max(axis=1) > ZERO
    rows = np.flatnonzero(reached)
    count, group = connected_components(W[rows][:, rows], directed=False)
    groups = (rows[group == g] for g in range(count))
    return [members for members in groups if _vanishing(W, rigid, members).shape[1]]


def null_space(W: Vector, on_bodies: Vector | None = None) -> Vector:
    """Return an orthonormal basis (k, n) of the kernel of a Gram matrix (k, k) of unit rows.

    With what the rows do to motions of rigid bodies, (k, q) of size 1, combinations x belong to it
    that do much more to these than to all else, x'Wx <= WEAK^2 |x'B|^2: those of a node between
    bodies whose surfaces are nearly parallel. The bodies move by what these rows lack; to close
    them, W^{-1} would move the node along the surfaces by that over the angle between them.
    """
    values, vectors = np.linalg.eigh(W)
    if on_bodies is None:
        return vectors[:, values <= PARALLEL]
    small = values <= PARALLEL + WEAK**2 * np.sum(on_bodies**2)
    vectors, moved = vectors[:, small], vectors[:, small].T @ on_bodies
    values, rotation = np.linalg.eigh(np.diag(values[small]) - WEAK**2 * moved @ moved.T)
    return np.asarray(vectors @ rotation[:, values <= PARALLEL])


def rank(A: Vector) -> int:
    """Return the rank of a matrix, which may be empty."""
    return int(
        np.count_nonzero(np.linalg.svd(A, compute_uv=False) > ZERO * np.abs(A).max(initial=0.0))
    )


def _vanishing(W: sp.csr_matrix, rigid: sp.csr_matrix | None, rows: Numbers) -> Vector:
    """Return `null_space` of some rows."""
    return null_space(_block(W, rows), None if rigid is None else _on_bodies(rigid, rows))


def _on_bodies(rigid: sp.csr_matrix, rows: Numbers) -> Vector:
    """Return what some rows do to motions of rigid bodies, relative to the largest of all."""
    size = np.abs(rigid.data).max(initial=0.0)
    return rigid[rows].toarray() / (size or 1.0)


def _block(W: sp.csr_matrix, members: Numbers) -> Vector:
    return W[members][:, members].toarray()


def _factor(W: sp.csr_matrix) -> SuperLU:
    """Factor a symmetric positive definite matrix, with pivots on its diagonal."""
    return splu(
        W.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
