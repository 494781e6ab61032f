"""The inverse of a coarse matrix by rows: a rank has its own rows, and changes them for each face.

GG' of a face is A + U S U' with A of all rows of B. Rows of B that leave the face give columns of U
with S = -1; there are few of them, since all rows between two subdomains act on the same few
unknowns. With X = A^{-1}, by Sherman, Morrison and Woodbury,

    (A + U S U')^{-1} = X - X U (S^{-1} + U'XU)^{-1} U'X,

so that A is factored once. A solve needs the whole right-hand side on every rank and a reduction of
as many numbers as U has columns. It is repeated for the residual as often as rounding asks for;
where that does not help, since A is much worse conditioned than the matrix of the face, the latter
is inverted itself.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

from mpi4py import MPI

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.factor import CoarseLayout
from fenics_tfeti.feti.local.cholesky import SparseCholesky
from fenics_tfeti.feti.tolerances import MANY, rounding
from fenics_tfeti.parallel import concatenate_buffers, first_of_rank
from fenics_tfeti.typing import Vector

# most refinements of a solution
_REFINEMENTS = 3


@dataclass(frozen=True)
class _Change:
    """U S U' on this rank."""

    columns: sp.csr_matrix  # own rows of U (own, q)
    moved: Vector  # own rows of X U (own, q)
    small: tuple[Vector, NDArray[np.int32]]  # LU factors of S^{-1} + U'XU, on all ranks


@dataclass(frozen=True)
class InverseByRows:
    """The inverse of a coarse matrix, of which each rank has its own rows; a `CoarseFactor`."""

    layout: CoarseLayout
    rows: Vector  # own rows of X (own, coarse)
    pins: Vector  # (coarse,): on the diagonal of A, besides GG'
    matrix: sp.csr_matrix  # own rows of the face's matrix (own, coarse)
    change: _Change | None = None  # difference of the matrix from A
    refinements: int = 0  # number of corrections of a solution by that for its residual

    @staticmethod
    def build(layout: CoarseLayout, own_rows: sp.csr_matrix, pins: Vector) -> InverseByRows:
        """Invert GG' of all rows with its pins, given this rank's rows of GG'. Collective.

        Every rank factors the whole matrix; the pins (coarse,) are added to the diagonal of GG'.
        Raises `FactorizationError` if the matrix is not positive definite.
        """
        matrix = layout.add_to_diagonal(own_rows, pins)
        factor = SparseCholesky(replace(layout, solver="redundant").rows(matrix), layout.package)
        own = np.arange(layout.own.start, layout.own.stop)
        unit = np.zeros((layout.size, own.size))
        unit[own, np.arange(own.size)] = 1.0
        inverse = InverseByRows(layout, np.ascontiguousarray(factor.solve(unit).T), pins, matrix)
        # what these refinements do not bring to rounding, those with a factor would not either
        return replace(inverse, refinements=min(inverse._refinements(), _REFINEMENTS))

    def changed(
        self, own_rows: sp.csr_matrix, removed: sp.csr_matrix, added: sp.csr_matrix, pins: Vector
    ) -> InverseByRows:
        """Return the inverse of A with columns of G removed and others added. Collective.

        The rows of the new GG' are those of this rank, (own, coarse), and the columns of G
        (coarse, k) those that it owns. Raises `FactorizationError` if the matrix is singular to
        rounding.
        """
        more = pins - self.pins
        pinned = np.flatnonzero(more)
        units = sp.csr_matrix(
            (np.ones(pinned.size), (pinned, np.arange(pinned.size))),
            shape=(self.layout.size, pinned.size),
        )
        lost, new = (self._of_all_ranks(independent_columns(c)) for c in (removed, added))
        U = sp.hstack([lost, new, units], format="csr")
        change = None
        if U.shape[1]:
            inverse_S = np.concatenate(
                [-np.ones(lost.shape[1]), np.ones(new.shape[1]), 1.0 / more[pinned]]
            )
            change = self._change(U, inverse_S)
        matrix = self.layout.add_to_diagonal(own_rows, pins)
        inverse = replace(self, matrix=matrix, change=change)
        refinements = inverse._refinements()
        if refinements > _REFINEMENTS:
            return InverseByRows.build(self.layout, own_rows, pins)
        return replace(inverse, refinements=refinements)

    def _change(self, U: sp.csr_matrix, inverse_S: Vector) -> _Change:
        columns, moved = U[self.layout.own], self.rows @ U
        small = np.ascontiguousarray(columns.T @ moved)
        self.layout.comm.Allreduce(MPI.IN_PLACE, small)
        with warnings.catch_warnings(action="ignore", category=scipy.linalg.LinAlgWarning):
            factor = scipy.linalg.lu_factor(small + np.diag(inverse_S), check_finite=False)
        return _Change(columns, moved, factor)

    def _refinements(self) -> int:
        """Return how many refinements make a trial accurate; one too many if these do not."""
        b = np.random.default_rng(0).standard_normal(self.layout.size)[self.layout.own]
        x, r = np.zeros_like(b), b
        for refinements in range(_REFINEMENTS + 1):
            with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
                x = x + self._once(self.layout.gather(r))
                whole = self.layout.gather(x)
                r = b - self.matrix @ whole
                size = np.abs(b) + abs(self.matrix) @ np.abs(whole)
            squares = np.array([r @ r, size @ size])
            self.layout.comm.Allreduce(MPI.IN_PLACE, squares)
            # a factor would leave as much
            if squares[0] <= rounding(1.0) ** 2 * squares[1]:
                return refinements
        return _REFINEMENTS + 1

    def _of_all_ranks(self, columns: sp.csc_matrix) -> sp.csc_matrix:
        first, count = first_of_rank(self.layout.comm, columns.shape[1])
        coo = columns.tocoo()
        row, column, data = concatenate_buffers(
            self.layout.comm, coo.row.astype(np.int64), coo.col.astype(np.int64) + first, coo.data
        )
        return sp.csc_matrix((data, (row, column)), shape=(self.layout.size, count))

    @property
    def entries(self) -> int:
        """Number of the inverse's entries, over all ranks."""
        return self.layout.size**2

    def _own_part(self, coarse: Vector) -> Vector:
        """Return this rank's part of the solution for a vector, or columns, of all ranks."""
        own = self._once(coarse)
        for _ in range(self.refinements):
            residual = coarse[self.layout.own] - self.matrix @ self.layout.gather(own)
            own = own + self._once(self.layout.gather(residual))
        return own

    def _once(self, coarse: Vector) -> Vector:
        own: Vector = self.rows @ coarse
        if self.change is not None:
            part = np.ascontiguousarray(self.change.columns.T @ own)
            self.layout.comm.Allreduce(MPI.IN_PLACE, part)
            own -= self.change.moved @ scipy.linalg.lu_solve(
                self.change.small, part, check_finite=False
            )
        return own

    def solve(self, coarse: Vector) -> Vector:
        """See `CoarseFactor.solve`."""
        return self.layout.gather(self._own_part(coarse))

    def solve_columns(self, coarse: Vector) -> Vector:
        """See `CoarseFactor.solve_columns`."""
        return self.layout.gather(self._own_part(coarse))

    def solve_own(self, own: Vector) -> tuple[Vector, Vector]:
        """See `CoarseFactor.solve_own`."""
        solution = self._own_part(self.layout.gather(own))
        return solution, self.layout.fetch(solution)

    def solve_sum(self, own: Vector, others: Vector, numbers: Vector) -> tuple[Vector, Vector]:
        """See `CoarseFactor.solve_sum`."""
        coarse, sums = self.layout.sum_whole(own, others, numbers)
        return self._own_part(coarse), sums


def independent_columns(columns: sp.spmatrix) -> sp.csc_matrix:
    """Return columns V with VV' = CC', as few as there are independent ones on the same unknowns.

    Examples
    --------
    >>> C = sp.csr_matrix([[1.0, 2.0, 0.0], [1.0, 2.0, 3.0], [0.0, 0.0, 4.0]])
    >>> V = independent_columns(C)
    >>> V.shape, np.allclose((V @ V.T).toarray(), (C @ C.T).toarray())
    ((3, 2), True)
    """
    C = sp.csc_matrix(columns)
    C.sort_indices()
    by_unknowns: dict[bytes, list[int]] = {}
    for j, (start, stop) in enumerate(zip(C.indptr[:-1], C.indptr[1:], strict=True)):
        if stop > start:
            by_unknowns.setdefault(C.indices[start:stop].tobytes(), []).append(j)
    parts = [sp.csc_matrix((C.shape[0], 0))]
    for unknowns, some in by_unknowns.items():
        at = np.frombuffer(unknowns, dtype=C.indices.dtype)
        values = np.array([C.data[C.indptr[j] : C.indptr[j + 1]] for j in some])
        left, sizes, _ = np.linalg.svd(values.T, full_matrices=False)
        kept = sizes > rounding(sizes.max(), MANY)
        V = left[:, kept] * sizes[kept]
        places = (np.tile(at, V.shape[1]), np.repeat(np.arange(V.shape[1]), at.size))
        parts.append(sp.csc_matrix((V.T.ravel(), places), shape=(C.shape[0], V.shape[1])))
    return sp.hstack(parts, format="csc")
