"""Sparse Cholesky and LDL' factors by CHOLMOD or MUMPS, through PETSc, or by rslab."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Literal, Protocol

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.errors import FactorizationError, InputError
from fenics_tfeti.feti.costs import COLUMNS
from fenics_tfeti.feti.factors.compiled import supernodal_library
from fenics_tfeti.feti.factors.supernodal import (
    DowndatedFactor,
    NotDefinite,
    Ordering,
    SupernodalFactor,
    out_of_memory,
)
from fenics_tfeti.feti.factors.threads import one_thread
from fenics_tfeti.petsc import PETSc
from fenics_tfeti.typing import Numbers, Operator, Vector

Package = Literal["auto", "cholmod", "rslab", "mumps"]

_PREFERENCE = ("cholmod", "rslab", "mumps")


def check_real_numbers(scalar: type = PETSc.ScalarType if PETSc else np.float64) -> None:
    """Check that PETSc computes with real numbers; raise `InputError` if it does not."""
    if np.issubdtype(scalar, np.complexfloating):
        raise InputError(
            "PETSc is built for complex numbers here, and contact needs real ones. Install the "
            "real build: 'pip install dolfinx-solver-real' in place of dolfinx-solver-complex, "
            "'apt install python3-dolfinx-real python3-petsc4py-real' with PETSC_DIR unset, or "
            "'conda install -c conda-forge fenics-dolfinx petsc=*=real*'"
        )


@cache
def _is_available(package: str) -> bool:
    if package == "rslab":
        return find_spec("rslab") is not None
    if PETSc is None:
        return False
    A = _petsc_matrix(sp.identity(1, format="csr"))
    pc = _petsc_cholesky(A, package)
    try:
        pc.setFactorSetUpSolverType()
    except PETSc.Error:
        return False
    finally:
        _destroy(pc, A)
    return True


def available_packages() -> list[str]:
    """Return which of CHOLMOD, rslab and MUMPS are installed, the preferred one first."""
    return [package for package in _PREFERENCE if _is_available(package)]


def choose_package(package: Package) -> str:
    """Return the name of the package to use.

    CHOLMOD solves with a factor of a few thousand unknowns fastest. rslab factors and solves as
    fast as MUMPS, in less memory and without its MPI communicators, which limit the number of
    factors. "auto" takes the first that is installed. Raises `FactorizationError` if the package
    is not installed, and `InputError` if PETSc computes with complex numbers.
    """
    check_real_numbers()
    available = available_packages()
    if package == "auto" and available:
        return available[0]
    if package in available:
        return package
    raise FactorizationError(
        f"there is no sparse Cholesky factorisation by {package!r}; available are "
        f"{available or 'neither CHOLMOD nor rslab nor MUMPS'}. Choose another 'factor', "
        "install a PETSc with CHOLMOD or MUMPS (Debian: python3-petsc4py-real, conda-forge: "
        "petsc4py), or 'pip install rslab'"
    )


def describe_package(package: str) -> str:
    """Return the name of a package, with what CHOLMOD's factors are applied by."""
    if package != "cholmod":
        return package
    library, reason = supernodal_library()
    return "cholmod, compiled solves" if library else f"cholmod, solves by PETSc: {reason}"


# largest residual of a useful factor, relative to the right-hand side
_USELESS = 1e-6
# the same of a downdated one: another factor takes its place
_ACCURATE = 1e-9
# new springs that make a tangent definite, at most: for each the factorisation starts again
_SPRINGS = 8
# more work than any solve has: rslab's solves stay on the thread that calls them
_NEVER = 2**62
# unknowns from which on CHOLMOD tries METIS' ordering too: the factors of smaller matrices are as
# large by AMD's, which takes less time
_TRY_METIS = 3000
# option for CHOLMOD's number of orderings to choose from: a given one, if any, AMD's, METIS'
_ORDERINGS = "mat_cholmod_nmethods"
# option for what CHOLMOD prints: at 0 no line for a matrix that is not positive definite, which is
# an error of ours
_PRINT = "mat_cholmod_print"
# MPI communicators that have to be free for another factor by MUMPS: it takes 5, dolfinx a few
_COMMUNICATORS = 16
# numbers of MUMPS' INFOG
_ERROR, _NEGATIVE_PIVOTS = 1, 12
# what packages say where an allocation has failed: PETSc's number, the end of its text for that of
# CHOLMOD, and INFOG(1) of MUMPS
_NO_MEMORY, _CHOLMOD_NO_MEMORY, _MUMPS_NO_MEMORY = 55, "status -2", -13
# INFOG(1) where the workspace is too small, and what is tried as ICNTL(14), the increase of its
# estimate in per cent: with the default of 20 definite matrices fail on three ranks
_TOO_SMALL, _WORKSPACES = (-8, -9), (100, 400, 1600)


class _Factor(Protocol):
    """A factor by a package; its constructor takes a matrix and may raise `_Unusable`."""

    negative: int  # number of negative pivots; unknown to CHOLMOD

    def solve(self, b: Vector) -> Vector:
        """Solve for a vector (n,)."""

    def solve_columns(self, b: Vector) -> Vector:
        """Solve for the columns of a matrix (n, k) in Fortran order."""

    @property
    def entries(self) -> int:
        """Number of the factor's entries."""


class _Unusable(Exception):
    """A package cannot factor the matrix, or the factor is of no use; the text says how."""


@dataclass(frozen=True)
class SparseFactor:
    """The solves with a factor by any package."""

    _factor: _Factor

    def solve(self, b: Vector) -> Vector:
        """Solve for a vector (n,) or, column by column, for a matrix (n, k)."""
        if b.ndim == 1:
            return self._factor.solve(b)
        x = np.empty(b.shape, order="F")
        for start in range(0, b.shape[1], COLUMNS):
            block = slice(start, start + COLUMNS)
            x[:, block] = self._factor.solve_columns(np.asfortranarray(b[:, block]))
        return x

    def between(self, unknowns: Numbers) -> Operator | None:
        """Return the inverse between some unknowns, for rows (k, b), where it is compiled."""
        factor = self._factor
        if isinstance(factor, DowndatedFactor) and isinstance(factor.of, SupernodalFactor):
            return factor.between(unknowns)
        return factor.between(unknowns) if isinstance(factor, SupernodalFactor) else None

    @property
    def entries(self) -> int:
        """Number of the factor's entries."""
        return self._factor.entries

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues; unknown to CHOLMOD, which factors definite matrices."""
        return self._factor.negative


def sparse_cholesky(
    matrix: sp.csr_matrix,
    package: str,
    quick: bool = False,
    width: int = 1,
    last: Ordering | None = None,
) -> SparseFactor:
    """Factor a sparse symmetric positive definite matrix.

    The matrix has both triangles; `FactorizationError` if it is not positive definite. Its unknowns
    are those of nodes, `width` each. CHOLMOD may take the `last` ordering, that of a matrix of
    about the same pattern, and leaves its own there. A `quick` factor is for few solves: CHOLMOD
    takes PETSc's nested dissection and tries no other ordering. That is half the time for a large
    coarse problem on a grid, and a factor up to two fifths larger.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> factor = sparse_cholesky(sp.csr_matrix(np.diag([1.0, 2.0])), choose_package("auto"))
    >>> factor.solve(np.array([3.0, 4.0])).round(12).tolist()
    [3.0, 2.0]
    """
    try:
        factor = SparseFactor(_factor(matrix, package, quick, width=width, last=last))
        if package != "cholmod" and factor.negative:
            raise _Unusable(f"{factor.negative} negative pivots")
        # CHOLMOD's failures, which PETSc does not pass on
        if not _energy_of_probe(factor, matrix.dot, matrix.shape[0]) > 0.0:
            raise _Unusable("negative energy")
    except _Unusable as error:
        raise FactorizationError(
            f"the Cholesky factorisation by {package} failed ({error}): the matrix of order "
            f"{matrix.shape[0]} is not positive definite"
        ) from error
    return factor


def downdated_cholesky(
    matrix: sp.csr_matrix, U: Vector, package: str, width: int = 1, last: Ordering | None = None
) -> SparseFactor:
    """Return the inverse of A - UU', which may be indefinite, by a Cholesky factor; its inertia.

    A (n, n) is as for `sparse_cholesky`, and U (n, k) has few columns. Where A has a few negative
    eigenvalues, springs are added that make it positive definite, in place, and taken off again by
    further columns of U; those of the matrix of the `last` ordering are tried first.
    `FactorizationError` if too many more are needed, if A - UU' is singular, or where CHOLMOD's
    solves are not compiled.
    """
    try:
        library = supernodal_library()[0] if package == "cholmod" else None
        if library is None:
            raise _Unusable("it needs CHOLMOD with compiled solves")
        # the springs are added to these arrays, on the diagonal
        matrix = _with_diagonal(matrix)
        matrix.sort_indices()
        spring, methods = matrix.diagonal().max(), _cholmod_orderings(matrix.shape[0])
        A = SupernodalFactor(library, matrix, width, methods, last, spring, _SPRINGS)
        held = np.zeros((matrix.shape[0], A.held.size))
        held[A.held, np.arange(A.held.size)] = np.sqrt(spring)
        U = np.hstack([U, held])
        factor = SparseFactor(DowndatedFactor(A, U))
        _energy_of_probe(factor, lambda x: matrix @ x - U @ (U.T @ x), matrix.shape[0], _ACCURATE)
    except (NotDefinite, _Unusable) as error:
        raise FactorizationError(
            f"the downdated Cholesky factorisation by {package} failed ({error})"
        ) from error
    return factor


def _with_diagonal(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """Return a matrix that stores its diagonal, zeros as well; the same one if it has none."""
    if matrix.diagonal().all():
        return matrix
    A, diagonal = matrix.tocoo(), np.arange(matrix.shape[0])
    row, column = np.append(A.row, diagonal), np.append(A.col, diagonal)
    data = np.append(A.data, np.zeros(diagonal.size))
    return sp.csr_matrix((data, (row, column)), shape=matrix.shape)


def sparse_ldl(matrix: sp.csr_matrix) -> SparseFactor:
    """Return the LDL' factor of a sparse symmetric matrix that may be indefinite; its inertia.

    It is by rslab or MUMPS: CHOLMOD does not pivot. Unknowns without a diagonal entry get a spring
    that the solves take off again, as rslab pivots within supernodes only. `FactorizationError` if
    the matrix is singular.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> factor = sparse_ldl(sp.csr_matrix(np.diag([1.0, -2.0])))
    >>> factor.solve(np.array([3.0, 4.0])).tolist(), factor.negative
    ([3.0, -2.0], 1)
    """
    package = next((p for p in ("rslab", "mumps") if _is_available(p)), None)
    if package is None:
        raise FactorizationError(
            "an indefinite tangent needs a symmetric indefinite factor, which CHOLMOD has not: "
            "install a PETSc with MUMPS, or 'pip install rslab'"
        )
    try:
        factor = SparseFactor(_ldl_with_springs(matrix, package))
        _energy_of_probe(factor, matrix.dot, matrix.shape[0])
    except (NotDefinite, _Unusable) as error:
        raise FactorizationError(
            f"the LDL' factorisation by {package} failed ({error}): the matrix of order "
            f"{matrix.shape[0]} is singular"
        ) from error
    return factor


def _ldl_with_springs(matrix: sp.csr_matrix, package: str) -> _Factor:
    """Return the LDL' factor of a matrix, made with springs where its diagonal is zero."""
    diagonal = matrix.diagonal()
    bare = np.flatnonzero(diagonal == 0.0)
    if not bare.size:
        return _factor(matrix, package, definite=False)
    spring = 2.0 * (float(np.abs(matrix.data).max(initial=0.0)) or 1.0)
    springs = np.where(diagonal == 0.0, spring, 0.0)
    factor = _factor((matrix + sp.diags(springs)).tocsr(), package, definite=False)
    U = np.zeros((diagonal.size, bare.size))
    U[bare, np.arange(bare.size)] = np.sqrt(spring)
    return DowndatedFactor(factor, U)


def _energy_of_probe(
    factor: SparseFactor, matrix: Operator, size: int, useless: float = _USELESS
) -> float:
    """Return the energy b'x of a solve, and find inaccurate factors of a matrix by it."""
    b = matrix(np.random.default_rng(0).standard_normal(size))
    x = factor.solve(b)
    with np.errstate(invalid="ignore", over="ignore"):
        residual = np.linalg.norm(matrix(x) - b) / np.linalg.norm(b)
        if not residual <= useless:
            raise _Unusable(f"relative residual {residual:.1e}")
        return float(b @ x)


def _factor(
    matrix: sp.csr_matrix,
    package: str,
    quick: bool = False,
    definite: bool = True,
    width: int = 1,
    last: Ordering | None = None,
) -> _Factor:
    if package == "rslab":
        return _RslabFactor(matrix)
    if package == "cholmod" and not quick and (library := supernodal_library()[0]) is not None:
        try:
            methods = _cholmod_orderings(matrix.shape[0])
            return SupernodalFactor(library, matrix, width, methods, last)
        except NotDefinite as error:
            raise _Unusable(str(error)) from error
    return _PetscFactor(matrix, package, quick, definite)


class _RslabFactor:
    """A supernodal LDL' factor; one thread, as the ranks share the processors."""

    def __init__(self, matrix: sp.csr_matrix) -> None:
        rslab = import_module("rslab")
        try:
            self._factor = rslab.ldlt(matrix, threads=1, solve_par_min_work=_NEVER)
        except RuntimeError as error:
            raise _Unusable(str(error)) from error
        _, self.negative, zero = map(int, self._factor.inertia)
        if zero:
            raise _Unusable(f"{zero} zero pivots")

    def solve(self, b: Vector) -> Vector:
        return self._factor.solve(np.ascontiguousarray(b, dtype=np.float64))

    def solve_columns(self, b: Vector) -> Vector:
        return self._factor.solve_many(b)

    @property
    def entries(self) -> int:
        return int(self._factor.factor_nnz)


def _petsc_matrix(matrix: sp.csr_matrix) -> PETSc.Mat:
    """Return PETSc's matrix on the same arrays where it can be."""
    rows = matrix if matrix.has_sorted_indices else matrix.sorted_indices()
    indices = (x.astype(PETSc.IntType, copy=False) for x in (rows.indptr, rows.indices))
    return PETSc.Mat().createAIJWithArrays(rows.shape, (*indices, rows.data), comm=PETSc.COMM_SELF)


def _petsc_cholesky(A: PETSc.Mat, package: str, definite: bool = True) -> PETSc.PC:
    """Return the PC that will factor a matrix; nothing is computed yet."""
    # MUMPS takes pivots of order two, and as they come for stability, where this is false
    A.setOption(PETSc.Mat.Option.SPD, definite)
    pc = PETSc.PC().create(A.getComm())
    pc.setOperators(A)
    pc.setType("cholesky")
    pc.setFactorSolverType(package)
    return pc


def _destroy(*things: PETSc.Object) -> None:
    """Free the memory of PETSc's objects at once; petsc4py only collects it as garbage."""
    for thing in things:
        thing.destroy()


class _PetscFactor:
    """A supernodal or simplicial factor by CHOLMOD, a multifrontal one by MUMPS."""

    negative = 0

    def __init__(self, matrix: sp.csr_matrix, package: str, quick: bool, definite: bool) -> None:
        if package == "mumps":
            _require_communicators()
        A = _petsc_matrix(matrix)
        pc = _petsc_cholesky(A, package, definite)
        try:
            with (
                _cholmod_options(pc, matrix.shape[0], quick and package == "cholmod"),
                one_thread(),
            ):
                pc.setUp()
            self._factor = pc.getFactorMatrix()
        except PETSc.Error as error:
            if error.ierr == _NO_MEMORY or str(error).endswith(_CHOLMOD_NO_MEMORY):
                raise out_of_memory(package, matrix.shape[0]) from error
            raise _Unusable(f"PETSc's error {error.ierr}") from error
        finally:
            # the factor outlives the PC and the matrix
            _destroy(pc, A)
        self._x = PETSc.Vec().createSeq(matrix.shape[0], comm=PETSc.COMM_SELF)
        self._b = self._x.duplicate()
        weakref.finalize(self, _destroy, self._factor, self._x, self._b).atexit = False
        if package == "mumps":
            status, self.negative = map(self._factor.getMumpsInfog, (_ERROR, _NEGATIVE_PIVOTS))
            if status == _MUMPS_NO_MEMORY:
                raise out_of_memory(package, matrix.shape[0])
            if status < 0:
                raise _Unusable(f"INFOG(1) is {status}")

    def solve(self, b: Vector) -> Vector:
        self._b.array_w[:] = b
        self._factor.solve(self._b, self._x)
        return self._x.array_r.copy()

    def solve_columns(self, b: Vector) -> Vector:
        B = PETSc.Mat().createDense(b.shape, array=b.ravel("F"), comm=PETSc.COMM_SELF)
        X = B.duplicate()
        self._factor.matSolve(B, X)
        x: Vector = X.getDenseArray().copy()
        _destroy(B, X)
        return x

    @property
    def entries(self) -> int:
        return int(self._factor.getInfo()["nz_used"])


def _orderings(size: int, quick: bool = False) -> int:
    """Return CHOLMOD's number of orderings to choose from; 0 tries METIS if AMD's is bad."""
    if size < _TRY_METIS:
        return 0
    return 1 if quick else 3


def _cholmod_orderings(size: int) -> int:
    """Return CHOLMOD's number of orderings that the user has chosen, or else ours."""
    return int(PETSc.Options().getInt(_ORDERINGS, _orderings(size)))


@contextmanager
def _cholmod_options(pc: PETSc.PC, size: int, quick: bool) -> Iterator[None]:
    """Choose what CHOLMOD prints and how it orders large matrices, unless the user has."""
    options = PETSc.Options()
    chosen = {_PRINT: 0, _ORDERINGS: _orderings(size, quick)}
    chosen = {name: value for name, value in chosen.items() if not options.hasName(name)}
    if quick and chosen.get(_ORDERINGS):
        pc.setFactorOrdering("nd")
    for name, value in chosen.items():
        options[name] = value
    try:
        yield
    finally:
        for name in chosen:
            options.delValue(name)


def _require_communicators() -> None:
    """Raise a `FactorizationError` if MPI has no communicators for another factor by MUMPS.

    MUMPS that does not get them breaks the factors that exist.
    """
    communicators = []
    try:
        for _ in range(_COMMUNICATORS):
            communicators.append(MPI.COMM_SELF.Dup())
    except MPI.Exception as error:
        raise FactorizationError(
            "MUMPS cannot start: the MPI library has no communicators left, and each factor holds "
            "some (MPICH has 2048, enough for about 400 factors a rank). Install rslab ('pip "
            "install rslab') or a PETSc with CHOLMOD, use fewer subdomains (a larger "
            "'subdomain_size') or more ranks; solved problems that are not needed any more hold "
            "communicators too"
        ) from error
    finally:
        for communicator in communicators:
            communicator.Free()


def _factored_in_enough_memory(A: PETSc.Mat) -> PETSc.PC:
    """Return the PC of a matrix factored by MUMPS, whose workspace is increased while it fails."""
    for workspace in _WORKSPACES:
        pc = _petsc_cholesky(A, "mumps")
        pc.setFactorSetUpSolverType()
        pc.getFactorMatrix().setMumpsIcntl(14, workspace)
        pc.setUp()
        if pc.getFactorMatrix().getMumpsInfog(_ERROR) not in _TOO_SMALL:
            break
        if workspace != _WORKSPACES[-1]:
            _destroy(pc)
    return pc


class DistributedCholesky:
    """The factor of a sparse symmetric positive definite matrix over several ranks, by MUMPS.

    The own rows (own, n) have both triangles; lower ranks have the rows before. All methods are
    collective; `FactorizationError` on all ranks if the matrix is not positive definite.

    Examples
    --------
    >>> import numpy as np, scipy.sparse as sp
    >>> factor = DistributedCholesky(MPI.COMM_SELF, sp.csr_matrix(np.diag([1.0, 2.0])))
    >>> factor.solve(np.array([3.0, 4.0])).round(12).tolist()
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
        pc = _factored_in_enough_memory(A)
        self._factor = pc.getFactorMatrix()
        self._x, self._b = A.createVecs()
        try:
            self._reject_indefinite(A)
        finally:
            _destroy(pc, A)

    def _reject_indefinite(self, A: PETSc.Mat) -> None:
        if self._factor.getMumpsInfog(_ERROR) == _MUMPS_NO_MEMORY:
            raise out_of_memory("mumps", A.size[0])
        probe, b = self._x.duplicate(), self._b.duplicate()
        begin, end = probe.getOwnershipRange()
        probe.array_w[:] = np.sin(np.arange(begin, end) + 1.0)
        A.mult(probe, b)
        self._factor.solve(b, self._x)
        residual = (A * self._x - b).norm()
        negative = self._factor.getMumpsInfog(_NEGATIVE_PIVOTS)
        if negative or not residual <= _USELESS * b.norm():
            raise FactorizationError(
                f"the distributed Cholesky factorisation by MUMPS is useless ({negative} negative "
                f"pivots, residual {residual:.1e}): the matrix of order {A.size[0]} is not "
                "positive definite"
            )

    def solve(self, b: Vector) -> Vector:
        """Return this rank's part of the solution for its part of the right-hand side."""
        self._b.array_w[:] = b
        self._factor.solve(self._b, self._x)
        return self._x.array_r.copy()

    @property
    def entries(self) -> int:
        """Number of the factor's entries over all ranks."""
        return int(self._factor.getMumpsInfog(29))
