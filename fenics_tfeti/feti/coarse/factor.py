"""Coarse matrices and their factors: redundant on every rank, or by rows.

Outside the iterations coarse vectors are whole on every rank. Within the iterations right-hand
sides are sums of the ranks' parts, and a rank needs only its own subdomains' part of the solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.by_rows import AgglomeratedCholesky
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky
from fenics_tfeti.parallel import all_to_all, concatenate_buffers, largest_of_ranks
from fenics_tfeti.typing import Numbers, Vector

CoarseSolverKind = Literal["auto", "redundant", "distributed"]

# Counted on lattices of 108 to 2916 cubes, 1 to 16 ranks (benchmarks/coarse.py):
# entries of the factor / size^1.5
ENTRIES = 3.6
# solves of a face; time of a factorisation in solves; time of MUMPS on one rank / CHOLMOD
_SOLVES, _FACTORISATION, SLOWER = 10, 80, 2
# collective calls of a solve by MUMPS, besides one for each rank; messages for each rank
COLLECTIVES, MESSAGES = 86, 3
# order from which a factor of the best ordering, a third smaller, is worth a tenth of time more
_LARGE = 100_000
# messages of a factorisation by MUMPS, in solves
MESSAGES_OF_FACTORISATION = 4
# bytes read of memory while a message is under way: 5 us at 10 GB/s
_LATENCY = 50_000
# MUMPS is chosen only if it halves the cost: the weight of its messages
_WEIGHT = 2.0


@dataclass(frozen=True)
class CoarseLayout:
    """Ownership of the coarse unknowns, and the communication of coarse vectors and matrices."""

    comm: MPI.Intracomm
    counts: tuple[int, ...]  # unknowns of each rank
    others: Numbers  # (h,): other ranks' unknowns that the multipliers here act on, ascending
    send_to: Mapping[int, Numbers]  # by rank: positions of its unknowns in `others`
    receive_from: Mapping[int, Numbers]  # by rank: own unknowns that are in its `others`
    solver: CoarseSolverKind
    package: str  # for the factors of whole matrices
    groups: int  # number of ranks that share a factor

    @staticmethod
    def build(
        comm: MPI.Intracomm, own: int, others: Numbers, solver: CoarseSolverKind, package: str
    ) -> CoarseLayout:
        """Find out which ranks share unknowns; collective.

        The `others` (h,) are ascending: other ranks' unknowns that this rank's multipliers act on.
        """
        counts = comm.allgather(own)
        ends = np.cumsum(counts)
        groups = choose_groups(comm.size, int(ends[-1]))
        first = int(ends[comm.rank]) - own
        rank = np.searchsorted(ends, others, side="right")
        to = {int(r): np.flatnonzero(rank == r) for r in np.unique(rank)}
        asked = all_to_all(
            comm, [others[to[r]] if r in to else others[:0] for r in range(comm.size)]
        )
        of = {r: numbers - first for r, numbers in enumerate(asked) if numbers.size}
        return CoarseLayout(comm, tuple(counts), others, to, of, solver, package, groups)

    @property
    def by_rows(self) -> bool:
        """True if a rank keeps only its own rows of coarse matrices."""
        return self.solver != "redundant"

    @property
    def first(self) -> int:
        """Number of this rank's first unknown."""
        return sum(self.counts[: self.comm.rank])

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return sum(self.counts)

    @property
    def own(self) -> slice:
        """Position of the own unknowns in a whole vector."""
        return slice(self.first, self.first + self.counts[self.comm.rank])

    def gather(self, own: Vector) -> Vector:
        """Return the whole vector, or matrix, of the ranks' own parts; one gathering."""
        if self.comm.size == 1:
            return own
        whole = np.empty((self.size, *own.shape[1:]))
        counts = [count * int(np.prod(own.shape[1:])) for count in self.counts]
        self.comm.Allgatherv(np.ascontiguousarray(own), [whole, counts])
        return whole

    def sum_whole(self, own: Vector, others: Vector, numbers: Vector) -> tuple[Vector, Vector]:
        """Return the whole sum of the ranks' parts, and that of their numbers; one reduction."""
        if self.comm.size == 1:
            return own, numbers
        part = np.zeros(self.size + numbers.size)
        part[self.own] = own
        part[self.others] = others
        part[self.size :] = numbers
        total = np.empty_like(part)
        self.comm.Allreduce(part, total)
        return total[: self.size], total[self.size :]

    def sum_own(self, own: Vector, others: Vector) -> Vector:
        """Return this rank's part of the sum of the ranks' parts; one neighbour exchange."""
        received = self._exchange(
            {rank: others[at] for rank, at in self.send_to.items()}, self.receive_from
        )
        total = own.copy()
        for rank, part in received.items():
            total[self.receive_from[rank]] += part
        return total

    def fetch(self, own: Vector) -> Vector:
        """Return `others` of a vector of which each rank has its own part; one exchange."""
        received = self._exchange(
            {rank: own[at] for rank, at in self.receive_from.items()}, self.send_to
        )
        others = np.empty(self.others.size)
        for rank, part in received.items():
            others[self.send_to[rank]] = part
        return others

    def _exchange(
        self, sent: Mapping[int, Vector], places: Mapping[int, Numbers]
    ) -> dict[int, Vector]:
        received = {rank: np.empty(at.size) for rank, at in places.items()}
        requests = [self.comm.Irecv(buffer, source=rank) for rank, buffer in received.items()]
        requests += [self.comm.Isend(part, dest=rank) for rank, part in sent.items()]
        MPI.Request.Waitall(requests)
        return received

    def rows(self, own_rows: sp.csr_matrix) -> sp.csr_matrix:
        """Return the rows of a coarse matrix that this rank keeps, from each rank's own rows."""
        if self.by_rows or self.comm.size == 1:
            return own_rows
        coo = own_rows.tocoo()
        row, column, data = concatenate_buffers(
            self.comm, coo.row.astype(np.int64) + self.first, coo.col.astype(np.int64), coo.data
        )
        return sp.csr_matrix((data, (row, column)), shape=(self.size, self.size))

    def largest_diagonal(self, rows: sp.csr_matrix) -> float:
        """Return the largest diagonal entry of a matrix, given the rows that this rank keeps."""
        return largest_of_ranks(self.comm, rows.diagonal(self.first if self.by_rows else 0))

    def add_to_diagonal(self, rows: sp.csr_matrix, diagonal: Vector) -> sp.csr_matrix:
        """Return the rows that this rank keeps with numbers (size,) added to the diagonal."""
        if not diagonal.any():
            return rows
        places = np.flatnonzero(diagonal)
        begin = self.first if self.by_rows else 0
        kept = places[(places >= begin) & (places < begin + rows.shape[0])]
        more = sp.csr_matrix((diagonal[kept], (kept - begin, kept)), shape=rows.shape)
        return (rows + more).tocsr()

    def factor(self, rows: sp.csr_matrix) -> CoarseFactor:
        """Factor a symmetric positive definite matrix, given the rows that this rank keeps.

        Collective.
        """
        if self.solver == "redundant" or not self.size:
            if not self.size:
                return CoarseFactor(self, None)
            is_quick = self.size < _LARGE
            return CoarseFactor(self, sparse_cholesky(rows.tocsr(), self.package, is_quick))
        return CoarseFactor(self, AgglomeratedCholesky(self.comm, rows, self.groups), by_rows=True)


@dataclass(frozen=True)
class CoarseFactor:
    """A factored coarse matrix, whole on every rank or by rows.

    A solve for a sum has one reduction of a whole vector. By rows it has one exchange of coarse
    unknowns, and the solver's own.
    """

    layout: CoarseLayout
    solver: Any  # None of a matrix of order 0: no subdomain can move
    by_rows: bool = False

    @property
    def entries(self) -> int:
        """Number of the factor's entries, over all ranks that share it."""
        return self.solver.entries if self.solver else 0

    def solve(self, coarse: Vector) -> Vector:
        """Solve for a vector, or the columns of a matrix, that every rank has; so it has all."""
        if not self.by_rows:
            return self.solver.solve(coarse) if self.solver else coarse
        own = coarse[self.layout.own]
        solved = np.array([self.solver.solve(column) for column in np.atleast_2d(own.T)])
        return self.layout.gather(solved.T.reshape(own.shape))

    def solve_own(self, own: Vector) -> tuple[Vector, Vector]:
        """Solve, given this rank's part; return that of `own` and of `others` in the solution."""
        if self.by_rows:
            solution = self.solver.solve(own)
            return solution, self.layout.fetch(solution)
        solution = self.solve(self.layout.gather(own))
        return solution[self.layout.own], solution[self.layout.others]

    def solve_sum(self, own: Vector, others: Vector, numbers: Vector) -> tuple[Vector, Vector]:
        """Solve for the sum of the ranks' parts; return this rank's part of the solution.

        This rank adds own (own,) to its unknowns and others (h,) to those of `CoarseLayout.others`.
        The numbers (k,) are summed over the ranks in the same reduction; their sums are returned as
        well.
        """
        if self.by_rows:
            sums = numbers.copy()
            if numbers.size:
                self.layout.comm.Allreduce(MPI.IN_PLACE, sums)
            return self.solver.solve(self.layout.sum_own(own, others)), sums
        coarse, sums = self.layout.sum_whole(own, others, numbers)
        return self.solve(coarse)[self.layout.own], sums


def choose_coarse_solver(ranks: int, size: int, mumps: bool = True) -> CoarseSolverKind:
    """Return the coarse solver that moves the least: redundant, or distributed.

    Examples
    --------
    >>> [choose_coarse_solver(ranks, 6 * 1000) for ranks in (1, 2, 16, 1000)]
    ['redundant', 'redundant', 'distributed', 'distributed']
    """
    redundant = (_SOLVES + _FACTORISATION) * _bytes_of_solve(size)
    if mumps and _bytes_of_face(ranks, size, choose_groups(ranks, size)) < redundant:
        return "distributed"
    return "redundant"


def choose_groups(ranks: int, size: int) -> int:
    """Return the number of ranks that share a factor by MUMPS so that it moves the least.

    Examples
    --------
    >>> [choose_groups(ranks, 6 * 1000) for ranks in (1, 2, 16, 1000)]
    [1, 2, 16, 16]
    """
    candidates = [*(1 << k for k in range(ranks.bit_length())), ranks]
    return min(candidates, key=lambda groups: _bytes_of_face(ranks, size, groups))


def _bytes_of_solve(size: int) -> float:
    """Return the bytes of a solve, which reads the entries of a factor twice."""
    return float(16.0 * ENTRIES * size**1.5)


def _bytes_of_face(ranks: int, size: int, groups: int) -> float:
    """Return the bytes of a face of the active set method with MUMPS on one rank of each group.

    They are memory that factors and solves read, and what could be read while messages are under
    way.
    """
    part = (_SOLVES + _FACTORISATION) * _bytes_of_solve(size) * SLOWER / groups
    rounds = (COLLECTIVES + groups) * np.log2(groups) + MESSAGES * (groups - 1)
    in_groups = 2 * (_SOLVES + 1) * np.log2(ranks / groups)
    of_mumps = (_SOLVES + MESSAGES_OF_FACTORISATION) * rounds
    return float(part + _WEIGHT * _LATENCY * (of_mumps + in_groups))
