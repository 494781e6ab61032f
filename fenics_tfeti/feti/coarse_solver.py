"""Where the coarse matrix is: whole on every rank, or its rows and its factor spread over the ranks.

Coarse vectors are short, and those outside the iterations are whole on every rank. Within the
iterations, right-hand sides come as sums of the ranks' parts, and a rank needs no more of the
solution than its own subdomains' part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.cholesky import DistributedCholesky, SparseCholesky

__all__ = ["CoarseFactor", "CoarseLayout", "CoarseSolverKind", "distribution_pays"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
CoarseSolverKind = Literal["auto", "redundant", "distributed"]


class CoarseFactor(Protocol):
    """A factored coarse matrix."""

    def solve(self, coarse: Vector) -> Vector:
        """Solve for a right-hand side that every rank has; every rank gets the whole solution."""
        ...

    def solve_sum(self, own: Vector, theirs: Vector) -> Vector:
        """Solve for the sum of the ranks' parts; return this rank's part of the solution.

        Parameters
        ----------
        own, theirs : (own,), (h,) array
            What this rank adds to its own and to other ranks' unknowns, `CoarseLayout.theirs`.
        """
        ...


@dataclass(frozen=True)
class CoarseLayout:
    """Whose the coarse unknowns are, and the communication of coarse vectors and matrices.

    Attributes
    ----------
    comm : MPI.Intracomm
        The ranks.
    first, own, size : int
        Number of this rank's first coarse unknown, how many it has, and how many there are.
    theirs : (h,) integer array
        Other ranks' unknowns that this rank's multipliers act on, ascending.
    to, of : mapping from int to integer array
        By rank: where its unknowns stand in `theirs`; which of the own unknowns it has in its.
    distributed : bool
        Whether a rank keeps its own rows of coarse matrices only.
    package : str
        Package for the factors of whole matrices.
    """

    comm: MPI.Intracomm
    first: int
    own: int
    size: int
    theirs: Numbers
    to: Mapping[int, Numbers]
    of: Mapping[int, Numbers]
    distributed: bool
    package: str

    @staticmethod
    def build(
        comm: MPI.Intracomm, own: int, theirs: Numbers, distributed: bool, package: str
    ) -> CoarseLayout:
        """Find out which ranks share unknowns; collective.

        Parameters
        ----------
        comm : MPI.Intracomm
            The ranks.
        own : int
            Number of this rank's unknowns.
        theirs : (h,) integer array
            Other ranks' unknowns that this rank's multipliers act on, ascending.
        distributed : bool
            Whether a rank keeps its own rows of coarse matrices only.
        package : str
            Package for the factors of whole matrices.
        """
        ends = np.cumsum(comm.allgather(own))
        first, size = int(ends[comm.rank]) - own, int(ends[-1])
        rank = np.searchsorted(ends, theirs, side="right")
        to = {int(r): np.flatnonzero(rank == r) for r in np.unique(rank)}
        asked = comm.alltoall([theirs[to[r]] if r in to else theirs[:0] for r in range(comm.size)])
        of = {r: numbers - first for r, numbers in enumerate(asked) if numbers.size}
        return CoarseLayout(comm, first, own, size, theirs, to, of, distributed, package)

    @property
    def mine(self) -> slice:
        """Where the own unknowns stand in a whole vector."""
        return slice(self.first, self.first + self.own)

    def gather(self, own: Vector) -> Vector:
        """Return the whole vector of the ranks' own parts; one gathering."""
        if self.comm.size == 1:
            return own
        return _concatenate(self.comm, own)

    def sum_whole(self, own: Vector, theirs: Vector) -> Vector:
        """Return the whole sum of the ranks' parts; one reduction."""
        if self.comm.size == 1:
            return own
        part, total = np.zeros(self.size), np.empty(self.size)
        part[self.mine] = own
        part[self.theirs] = theirs
        self.comm.Allreduce(part, total)
        return total

    def sum_own(self, own: Vector, theirs: Vector) -> Vector:
        """Return this rank's part of the sum of the ranks' parts; one neighbour exchange."""
        received = {rank: np.empty(at.size) for rank, at in self.of.items()}
        requests = [self.comm.Irecv(buffer, source=rank) for rank, buffer in received.items()]
        requests += [self.comm.Isend(theirs[at], dest=rank) for rank, at in self.to.items()]
        MPI.Request.Waitall(requests)
        total = own.copy()
        for rank, part in received.items():
            total[self.of[rank]] += part
        return total

    def rows(self, own_rows: sp.csr_matrix) -> sp.csr_matrix:
        """Return the rows of a coarse matrix that this rank keeps, from each rank's own rows."""
        if self.distributed or self.comm.size == 1:
            return own_rows
        coo = own_rows.tocoo()
        row, column, data = (
            _concatenate(self.comm, part)
            for part in (coo.row.astype(np.int64) + self.first, coo.col.astype(np.int64), coo.data)
        )
        return sp.csr_matrix((data, (row, column)), shape=(self.size, self.size))

    def largest_diagonal(self, rows: sp.csr_matrix) -> float:
        """Return the largest diagonal entry of a matrix, given the rows that this rank keeps."""
        diagonal = rows.diagonal(self.first if self.distributed else 0)
        return float(self.comm.allreduce(float(diagonal.max(initial=0.0)), MPI.MAX))

    def add_to_diagonal(self, rows: sp.csr_matrix, places: Numbers, value: float) -> sp.csr_matrix:
        """Return the rows that this rank keeps with a number added at some places."""
        begin = self.first if self.distributed else 0
        kept = places[(places >= begin) & (places < begin + rows.shape[0])]
        values = np.full(kept.size, value)
        return (rows + sp.csr_matrix((values, (kept - begin, kept)), shape=rows.shape)).tocsr()

    def factor(self, rows: sp.csr_matrix) -> CoarseFactor:
        """Factor a symmetric positive definite matrix, given the rows that this rank keeps."""
        if self.distributed:
            return _Distributed(self, DistributedCholesky(self.comm, rows))
        return _Redundant(self, SparseCholesky(rows.tocsr(), self.package))


@dataclass(frozen=True)
class _Redundant:
    """Every rank has the whole factor: one reduction of a coarse vector for each solve."""

    layout: CoarseLayout
    whole: SparseCholesky

    def solve(self, coarse: Vector) -> Vector:
        return self.whole.solve(coarse)

    def solve_sum(self, own: Vector, theirs: Vector) -> Vector:
        return self.whole.solve(self.layout.sum_whole(own, theirs))[self.layout.mine]


@dataclass(frozen=True)
class _Distributed:
    """The ranks share the factor: one exchange of coarse unknowns, and the messages of MUMPS."""

    layout: CoarseLayout
    shared: DistributedCholesky

    def solve(self, coarse: Vector) -> Vector:
        return self.layout.gather(self.shared.solve(coarse[self.layout.mine]))

    def solve_sum(self, own: Vector, theirs: Vector) -> Vector:
        return self.shared.solve(self.layout.sum_own(own, theirs))


def _concatenate(comm: MPI.Intracomm, part: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the ranks' arrays one behind the other, by buffers."""
    counts = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([part.size]), counts)
    whole = np.empty(int(counts.sum()), dtype=part.dtype)
    comm.Allgatherv(np.ascontiguousarray(part), [whole, counts.astype(int).tolist()])
    return whole


def distribution_pays(comm: MPI.Intracomm, own_rows: sp.csr_matrix) -> bool:
    """Decide."""
    return False
