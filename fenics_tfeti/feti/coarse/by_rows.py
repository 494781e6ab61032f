"""Factors of coarse matrices of which each rank has its own rows, by MUMPS on few ranks."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.factors.cholesky import DistributedCholesky
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# sub-communicators, cached as an attribute of their parent: number of groups -> the group, their
# first ranks
_KEYVAL = MPI.Comm.Create_keyval()


class AgglomeratedCholesky:
    """The factor of a positive definite matrix on one rank of each group of neighbours, by MUMPS.

    A solve gathers the right-hand side in each group, and scatters the solution. All methods are
    collective; `FactorizationError` on all ranks if the matrix is not positive definite.
    """

    def __init__(self, comm: MPI.Intracomm, own_rows: sp.csr_matrix, groups: int) -> None:
        self._group, first_ranks = _groups(comm, groups)
        self._counts = self._group.allgather(own_rows.shape[0])
        parts = self._group.gather(own_rows)
        self._factor: DistributedCholesky | None = None
        with raise_collectively(comm):
            if parts is not None:
                self._factor = DistributedCholesky(first_ranks, sp.vstack(parts, format="csr"))
        self.entries: int = comm.bcast(self._factor.entries if self._factor else 0)

    def solve(self, own: Vector) -> Vector:
        """Return this rank's part of the solution for its part of the right-hand side."""
        x = np.empty(own.size)
        if self._factor is None:
            self._group.Gatherv(np.ascontiguousarray(own), None)
            self._group.Scatterv(None, x)
        else:
            b = np.empty(sum(self._counts))
            self._group.Gatherv(np.ascontiguousarray(own), [b, self._counts])
            self._group.Scatterv([self._factor.solve(b), self._counts], x)
        return x


def _groups(comm: MPI.Intracomm, number: int) -> tuple[MPI.Intracomm, MPI.Intracomm]:
    """Return this rank's group of neighbouring ranks, and the first ranks of all groups.

    MPI limits the number of communicators, which are not collected as garbage: they are made once.
    Collective.
    """
    comm = MPI.Intracomm(comm)  # the constructor of a derived class may ask for arguments
    known: Any = comm.Get_attr(_KEYVAL) or {}
    if number not in known:
        group = comm.Split(comm.rank * number // comm.size, comm.rank)
        first_ranks = comm.Split(MPI.UNDEFINED if group.rank else 0, comm.rank)
        known = known | {number: (group, first_ranks)}
        comm.Set_attr(_KEYVAL, known)
    return known[number]
