"""Solvers of coarse matrices of which each rank has its own rows: MUMPS on few ranks, and GAMG."""

from __future__ import annotations

import itertools
import logging
from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.factors.cholesky import DistributedCholesky
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

logger = logging.getLogger(__name__)

# residual of conjugate gradients, relative to the right-hand side: with 1e-8 the active set method
# takes up to ten times as many products with F
_RTOL = 1e-13
_MOST_ITERATIONS = 200
_GAMG = {
    "pc_gamg_threshold": 0.03,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "pbjacobi",
}
_PREFIXES = (f"tfeti_coarse_{number}_" for number in itertools.count())

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


class MultigridSolver:
    """Conjugate gradients with PETSc's algebraic multigrid GAMG; MUMPS where they are too slow.

    The motions (own, k) are this rank's rows of the near null space, and `block` unknowns belong to
    each subdomain. The `groups` are those of `AgglomeratedCholesky`, which takes over for good with
    the first right-hand side for which the iterations do not converge. Collective.
    """

    entries = 0

    def __init__(
        self,
        comm: MPI.Intracomm,
        own_rows: sp.csr_matrix,
        motions: Vector,
        block: int,
        groups: int,
    ) -> None:
        # petsc4py takes no class derived from communicators
        self._comm, self._rows, self._groups = MPI.Intracomm(comm), own_rows, groups
        self._direct: AgglomeratedCholesky | None = None
        PETSc.garbage_cleanup(self._comm)
        rows = own_rows.sorted_indices()
        indices = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType))
        local = (rows.shape[0], PETSc.DETERMINE)
        A = PETSc.Mat().createAIJ(
            (local, (rows.shape[0], rows.shape[1])),
            bsize=block,
            csr=(*indices, rows.data),
            comm=self._comm,
        )
        A.setOption(PETSc.Mat.Option.SPD, True)
        self._x, self._b = A.createVecs()
        A.setNearNullSpace(self._orthonormal(motions))
        self._ksp = _conjugate_gradients(A)

    def _orthonormal(self, motions: Vector) -> PETSc.NullSpace:
        """Return the span of the motions, as columns of an orthonormal matrix."""
        gram = self._comm.allreduce(motions.T @ motions)
        sizes, turn = np.linalg.eigh(gram)
        kept = sizes > 1e-10 * sizes.max(initial=0.0)
        vectors = []
        for column in (motions @ (turn[:, kept] / np.sqrt(sizes[kept]))).T:
            vector = self._x.duplicate()
            vector.array_w[:] = column
            vector.normalize()
            vectors.append(vector)
        return PETSc.NullSpace().create(vectors=vectors, comm=self._comm)

    def solve(self, own: Vector) -> Vector:
        """Return this rank's part of the solution for its part of the right-hand side."""
        if self._direct is None:
            self._b.array_w[:] = own
            self._ksp.solve(self._b, self._x)
            if self._ksp.getConvergedReason() > 0:
                return self._x.array_r.copy()
            if self._comm.rank == 0:
                logger.info(
                    "coarse problem: no convergence in %d iterations with GAMG, factored by MUMPS",
                    self._ksp.getIterationNumber(),
                )
            self._direct = AgglomeratedCholesky(self._comm, self._rows, self._groups)
        return self._direct.solve(own)


def _conjugate_gradients(A: PETSc.Mat) -> PETSc.KSP:
    """Return conjugate gradients for a matrix with the multigrid set up."""
    ksp = PETSc.KSP().create(A.getComm())
    ksp.setOperators(A)
    ksp.setType("cg")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=_RTOL, atol=0.0, max_it=_MOST_ITERATIONS)
    ksp.getPC().setType("gamg")
    ksp.setOptionsPrefix(next(_PREFIXES))
    options = PETSc.Options(ksp.getOptionsPrefix())
    for name, value in _GAMG.items():
        options[name] = value
    ksp.setFromOptions()
    ksp.setUp()
    for name in _GAMG:
        options.delValue(name)
    return ksp
