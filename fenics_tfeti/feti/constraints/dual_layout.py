"""The layout of the dual vectors over the ranks: exchange with neighbours, inner products.

A product with F takes one exchange with the neighbours, `DualLayout.sum`; inner products are
reduced by `DualLayout.space`. Both communicate buffers, without pickling.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti import interruption
from fenics_tfeti.parallel import Directory, all_to_all
from fenics_tfeti.qp import Space
from fenics_tfeti.typing import Array, Numbers, Vector


class DualLayout:
    """The distribution of a vector: each rank holds the components that it needs.

    A component may be held by several ranks; the lowest of them owns it. The global numbers (m,)
    of a rank are distinct. In local order its owned components come first, then the others, both by
    ascending `place` (m,), the numbers by default. All ranks that hold a component have bitwise
    equal values of it. `size` is the number of components over all ranks.
    """

    def __init__(self, comm: MPI.Intracomm, numbers: Numbers, place: Numbers | None = None) -> None:
        self.comm = comm
        ascending = np.argsort(numbers)
        numbers = numbers[ascending]
        place = numbers if place is None else place[ascending]
        keys, ranks = Directory(comm, numbers).forward(
            numbers, np.full(numbers.size, comm.rank, dtype=np.int64)
        )
        owner = np.full(numbers.size, comm.size, dtype=np.int64)
        # the ranks of a key ascend, and of several assignments the last one counts
        owner[np.searchsorted(numbers, keys)[::-1]] = ranks[::-1]
        order = np.lexsort((place, owner != comm.rank))
        self.numbers: Numbers = numbers[order]
        self.owned = int(np.count_nonzero(owner == comm.rank))
        self.size: int = comm.allreduce(self.owned)
        self._sorted, self._order = numbers, order
        self._neighbours = {
            int(rank): self.local(np.sort(keys[ranks == rank]))
            for rank in np.unique(ranks[ranks != comm.rank])
        }
        self._shared = np.unique(
            np.concatenate([np.zeros(0, dtype=np.int64), *self._neighbours.values()])
        )
        self.space = Space(self.owned, self._sum_over_ranks, self._sum_and_min_over_ranks)

    def local(self, numbers: Numbers) -> Numbers:
        """Return the local positions of global numbers that this rank holds."""
        inverse = np.empty(self._order.size, dtype=np.int64)
        inverse[self._order] = np.arange(self._order.size)
        return inverse[np.searchsorted(self._sorted, numbers)]

    def sum(self, part: Vector) -> Vector:
        """Add up the parts of each component over the ranks that hold it; one exchange.

        The part is (m,), or (m, k) of several vectors.
        """
        if self.comm.size == 1:
            return part
        shape = part.shape[1:]
        received = {
            rank: np.empty((shared.size, *shape)) for rank, shared in self._neighbours.items()
        }
        requests = [self.comm.Irecv(buffer, source=rank) for rank, buffer in received.items()]
        requests += [
            self.comm.Isend(np.ascontiguousarray(part[shared]), dest=rank)
            for rank, shared in self._neighbours.items()
        ]
        MPI.Request.Waitall(requests)
        total = part.copy()
        total[self._shared] = 0.0
        # in the order of ranks everywhere: equal bits, hence equal decisions at the bounds
        for rank in sorted([*received, self.comm.rank]):
            if rank == self.comm.rank:
                total[self._shared] += part[self._shared]
            else:
                total[self._neighbours[rank]] += received[rank]
        return total

    def owned_part(self, x: Vector) -> Vector:
        """Return x with zeros for components that are not owned; x is the sum of these parts."""
        part = x.copy()
        part[self.owned :] = 0.0
        return part

    def sum_sparse(self, part: sp.csr_matrix) -> sp.csr_matrix:
        """Add up the parts of sparse rows over the ranks that hold them. Collective.

        The columns of the part (m, k) are global.
        """
        if self.comm.size == 1:
            return part
        entries = part.tocoo()
        rows, columns = entries.row.astype(np.int64), entries.col.astype(np.int64)
        messages: list[tuple[Array, ...]] = [
            (rows[:0], columns[:0], entries.data[:0]) for _ in range(self.comm.size)
        ]
        for rank, shared in self._neighbours.items():
            chosen = np.isin(rows, shared)
            messages[rank] = (self.numbers[rows[chosen]], columns[chosen], entries.data[chosen])
        arrived = [np.concatenate(c) for c in zip(*all_to_all(self.comm, messages), strict=True)]
        rows = np.concatenate([rows, self.local(arrived[0])])
        columns = np.concatenate([columns, arrived[1]])
        values = np.concatenate([entries.data, arrived[2]])
        return sp.csr_matrix((values, (rows, columns)), shape=part.shape)

    def _sum_over_ranks(self, partial: Vector) -> Vector:
        if self.comm.size == 1:
            interruption.agree(interruption.received())
            return partial
        # the ranks that were interrupted travel along: no message of their own, one answer for all
        packed = np.append(partial, float(interruption.received()))
        total = np.empty_like(packed)
        self.comm.Allreduce(packed, total)
        interruption.agree(bool(total[-1] > 0.0))
        return total[:-1].reshape(partial.shape)

    def _sum_and_min_over_ranks(self, partial: Vector) -> Vector:
        if self.comm.size == 1:
            return partial
        total = np.empty_like(partial)
        # one item of a derived type: MPI may reduce arrays in pieces
        kind = MPI.DOUBLE.Create_contiguous(partial.size).Commit()
        self.comm.Allreduce([partial, 1, kind], [total, 1, kind], _SUM_AND_MIN)
        kind.Free()
        return total


def _sum_and_min(first: Any, second: Any, kind: MPI.Datatype) -> None:
    """Add two buffers, but take the minimum of their last components."""
    x, y = np.frombuffer(first), np.frombuffer(second)
    y[:-1] += x[:-1]
    y[-1] = min(x[-1], y[-1])


_SUM_AND_MIN = MPI.Op.Create(_sum_and_min, commute=True)


def seeded_vector(numbers: NDArray[np.int64]) -> Vector:
    """Return pseudo-random components in (-1, 1) that depend on global numbers only.

    All holders of a component get the same value, on any number of ranks, without communication.
    The mixing function is that of splitmix64.
    """
    z = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
    z ^= z >> np.uint64(31)
    return z / 2.0**63 - 1.0
