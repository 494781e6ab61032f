"""Sparse Cholesky factors by CHOLMOD or MUMPS, through PETSc."""

from __future__ import annotations

from typing import Literal

from mpi4py import MPI  # first, or the wheels' petsc4py does not find the MPI library

from petsc4py import PETSc

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import FactorizationError

__all__ = [
    "DistributedCholesky",
    "Package",
    "SparseCholesky",
    "available_packages",
    "choose_package",
]

Vector = NDArray[np.float64]
Package = Literal["auto", "cholmod", "mumps"]

_PREFERENCE = ("cholmod", "mumps")


def _petsc_matrix(matrix: sp.csr_matrix) -> PETSc.Mat:
    indices = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType))
    A = PETSc.Mat().createAIJ(matrix.shape, csr=(*indices, matrix.data), comm=PETSc.COMM_SELF)
    A.setOption(PETSc.Mat.Option.SPD, True)
    return A


def _has_package(package: str) -> bool:
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOperators(_petsc_matrix(sp.identity(1, format="csr")))
    pc.setType("cholesky")
    pc.setFactorSolverType(package)
    try:
        pc.setFactorSetUpSolverType()
    except PETSc.Error:
        return False
    finally:
        pc.destroy()
    return True


def available_packages() -> list[str]:
    """Return which of CHOLMOD and MUMPS this PETSc has, the preferred one first."""
    return [package for package in _PREFERENCE if _has_package(package)]


def choose_package(package: Package) -> str:
    """Return the name of the package to use.

    Raises
    ------
    FactorizationError
        If PETSc was built without it.
    """
    available = available_packages()
    if package == "auto" and available:
        return available[0]
    if package in available:
        return package
    raise FactorizationError(
        f"PETSc has no sparse Cholesky factorisation by {package!r}; it has "
        f"{available or 'neither CHOLMOD nor MUMPS'}. Choose another 'factor', or install a PETSc "
        "with MUMPS (Debian: python3-petsc4py-real, conda-forge: petsc4py)"
    )


# MUMPS' INFOG(1) when it did not initialise
_NO_COMMUNICATOR = -3
# INFOG(12)
_NEGATIVE_PIVOTS = 12
# right-hand sides that are solved for together
_COLUMNS = 64


class SparseCholesky:
    """The factor of a sparse symmetric positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) scipy.sparse.csr_matrix
        Both triangles.
    package : str
        "cholmod" or "mumps".

    Raises
    ------
    FactorizationError
        If the matrix is not positive definite.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> factor = SparseCholesky(sp.csr_matrix(np.diag([1.0, 2.0])), choose_package("auto"))
    >>> factor.solve(np.array([3.0, 4.0])).tolist()
    [3.0, 2.0]
    """

    def __init__(self, matrix: sp.csr_matrix, package: str) -> None:
        pc = PETSc.PC().create(PETSc.COMM_SELF)
        pc.setOperators(_petsc_matrix(matrix))
        pc.setType("cholesky")
        pc.setFactorSolverType(package)
        pc.setFactorSetUpSolverType()
        self._factor = pc.getFactorMatrix()
        try:
            pc.setUp()
        except PETSc.Error as error:
            raise FactorizationError(
                f"the Cholesky factorisation by {package} failed: the matrix of order "
                f"{matrix.shape[0]} is not positive definite"
            ) from error
        self._pc = pc
        self._x = PETSc.Vec().createSeq(matrix.shape[0], comm=PETSc.COMM_SELF)
        self._b = self._x.duplicate()
        self._reject_indefinite(matrix, package)

    def _reject_indefinite(self, matrix: sp.csr_matrix, package: str) -> None:
        if package == "mumps" and self._factor.getMumpsInfog(1) == _NO_COMMUNICATOR:
            raise FactorizationError(
                "MUMPS could not start: the MPI library has no communicators left, and each factor "
                "holds some (MPICH has 2048, enough for about 400 factors a rank). Use fewer "
                "subdomains (a larger 'subdomain_size'), more ranks, or a PETSc with CHOLMOD; "
                "solved problems that are not needed any more hold communicators too"
            )
        # MUMPS factors indefinite matrices, and PETSc passes on no failure of CHOLMOD: try a solve
        probe = np.random.default_rng(0).standard_normal(matrix.shape[0])
        b = matrix @ probe
        x = self.solve(b)
        with np.errstate(invalid="ignore", over="ignore"):
            residual = np.linalg.norm(matrix @ x - b)
            positive = float(b @ x) > 0.0
        if not (positive and residual <= 1e-6 * np.linalg.norm(b)):
            raise FactorizationError(
                f"the Cholesky factorisation by {package} is useless (residual {residual:.1e}): "
                f"the matrix of order {matrix.shape[0]} is not positive definite"
            )

    def solve(self, b: Vector) -> Vector:
        """Solve for a vector (n,) or, column by column, for a matrix (n, k)."""
        if b.ndim == 2:
            return self._solve_columns(b)
        self._b.array_w[:] = b
        self._factor.solve(self._b, self._x)
        x: Vector = self._x.array_r.copy()
        return x

    def _solve_columns(self, b: Vector) -> Vector:
        """Solve for a matrix, some columns at a time: the factor is read once for all of them."""
        x = np.empty(b.shape, order="F")
        for start in range(0, b.shape[1], _COLUMNS):
            columns = np.asfortranarray(b[:, start : start + _COLUMNS])
            result = np.empty_like(columns)
            mats = [
                PETSc.Mat().createDense(array.shape, array=array.ravel("F"), comm=PETSc.COMM_SELF)
                for array in (columns, result)
            ]
            self._factor.matSolve(*mats)
            x[:, start : start + _COLUMNS] = mats[1].getDenseArray()
            for mat in mats:
                mat.destroy()
        return x

    @property
    def entries(self) -> int:
        """Number of the factor's entries."""
        return int(self._factor.getInfo()["nz_used"])


class DistributedCholesky:
    """The factor of a sparse symmetric positive definite matrix over several ranks, by MUMPS.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks; everything here is collective.
    own_rows : (own, n) scipy.sparse.csr_matrix
        This rank's rows, both triangles; lower ranks have the rows before.

    Raises
    ------
    FactorizationError
        If the matrix is not positive definite, on all ranks.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> factor = DistributedCholesky(MPI.COMM_SELF, sp.csr_matrix(np.diag([1.0, 2.0])))
    >>> factor.solve(np.array([3.0, 4.0])).tolist()
    [3.0, 2.0]
    """

    def __init__(self, comm: MPI.Intracomm, own_rows: sp.csr_matrix) -> None:
        # petsc4py takes no class derived from communicators
        comm = MPI.Intracomm(comm)
        # factors that are not needed any more; MUMPS can end only on all ranks at once
        PETSc.garbage_cleanup(comm)
        rows = own_rows.sorted_indices()
        indices = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType))
        A = PETSc.Mat().createAIJ((rows.shape, rows.shape), csr=(*indices, rows.data), comm=comm)
        A.setOption(PETSc.Mat.Option.SPD, True)
        pc = PETSc.PC().create(comm)
        pc.setOperators(A)
        pc.setType("cholesky")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        pc.setUp()
        self._pc, self._factor = pc, pc.getFactorMatrix()
        self._x, self._b = A.createVecs()
        self._reject_indefinite(A)

    def _reject_indefinite(self, A: PETSc.Mat) -> None:
        probe, b = self._x.duplicate(), self._b.duplicate()
        begin, end = probe.getOwnershipRange()
        probe.array_w[:] = np.sin(np.arange(begin, end) + 1.0)
        A.mult(probe, b)
        self._factor.solve(b, self._x)
        residual = (A * self._x - b).norm()
        negative = self._factor.getMumpsInfog(_NEGATIVE_PIVOTS)
        if negative or not residual <= 1e-6 * b.norm():
            raise FactorizationError(
                f"the distributed Cholesky factorisation by MUMPS is useless ({negative} negative "
                f"pivots, residual {residual:.1e}): the matrix of order {A.size[0]} is not "
                "positive definite"
            )

    def solve(self, own: Vector) -> Vector:
        """Return this rank's part (own,) of the solution for its part of the right-hand side."""
        self._b.array_w[:] = own
        self._factor.solve(self._b, self._x)
        x: Vector = self._x.array_r.copy()
        return x

    @property
    def entries(self) -> int:
        """Number of the factor's entries over all ranks."""
        return int(self._factor.getMumpsInfog(29))
