"""Sparse factors by each package that is installed, against dense algebra; what they hold."""

from __future__ import annotations

import resource
import sys

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
import pytest
import scipy.sparse as sp
from new_process import run_python

from fenics_tfeti import FactorizationError, InputError
from fenics_tfeti.feti.factors import cholesky
from fenics_tfeti.feti.factors.cholesky import (
    DistributedCholesky,
    available_packages,
    check_real_numbers,
    choose_package,
    downdated_cholesky,
    sparse_cholesky,
    sparse_ldl,
)
from fenics_tfeti.feti.factors.compiled import supernodal_library

N = 40
each_package = pytest.mark.parametrize("package", available_packages())


def definite(seed: int = 0) -> sp.csr_matrix:
    """Return a sparse symmetric positive definite matrix of order N."""
    A = sp.random(N, N, density=0.1, random_state=seed, format="csr")
    return (A @ A.T + sp.identity(N)).tocsr()


def test_complex_numbers_are_refused():
    check_real_numbers(np.float64)
    with pytest.raises(InputError, match="built for complex numbers .* dolfinx-solver-real"):
        check_real_numbers(np.complex128)


@each_package
@pytest.mark.parametrize("columns", [(), 1, 3, 64, 65, 130])
def test_right_hand_sides(package, columns):
    """Solutions are not overwritten by the next."""
    A, b = definite(), np.random.default_rng(1).standard_normal((N, *np.atleast_1d(columns)))
    factor = sparse_cholesky(A, package)
    x = factor.solve(b)
    factor.solve(np.zeros(N))
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), rtol=0.0, atol=1e-12)


@each_package
def test_factor_of_a_tridiagonal_matrix_has_little_fill(package):
    """MUMPS and rslab store some zeros to work on dense blocks."""
    ones = np.ones(N - 1)
    A = sp.diags([-ones, np.full(N, 3.0), -ones], [-1, 0, 1], format="csr")
    assert 2 * N - 1 <= sparse_cholesky(A, package).entries <= N * (N + 1) // 4


@each_package
@pytest.mark.parametrize("matrix", [
    -definite(),
    sp.diags(np.arange(N, dtype=float), format="csr"),
    definite() * np.nan,
    sp.csr_matrix(np.ones((200, 200)) - 0.5 * np.eye(200)),
], ids=["negative definite", "singular", "not a number", "dense"])  # fmt: skip
def test_matrix_that_is_not_positive_definite_is_refused(package, matrix, capfd):
    """Nothing is printed, though CHOLMOD's supernodal factor would tell by a line of its own."""
    message = f"of order {matrix.shape[0]} is not positive definite"
    with pytest.raises(FactorizationError, match=message):
        sparse_cholesky(matrix, package)
    assert capfd.readouterr() == ("", "")
    if package != "cholmod":
        # PETSc's CHOLMOD factors small matrices as LDL' and does not tell the signs of D
        A = sp.diags(np.where(np.arange(N) == N // 2, -1.0, 1e3), format="csr")
        with pytest.raises(FactorizationError, match="1 negative"):
            sparse_cholesky(A, package)


def laplacian(n: int) -> sp.csr_matrix:
    """Return the seven-point stencil on a cube of n^3 nodes."""
    line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n))
    return sp.csr_matrix(sp.kronsum(sp.kronsum(line, line), line))


def resident_bytes() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


@each_package
def test_factors_free_their_memory(package):
    A, b = laplacian(8), np.ones((8**3, 3))

    def make_factors(number: int) -> int:
        for _ in range(number):
            factor = sparse_cholesky(A, package)
            factor.solve(b)
        return factor.entries

    entries = make_factors(50)
    before = resident_bytes()
    make_factors(100)
    assert resident_bytes() - before < 25 * 8 * entries


@pytest.mark.skipif(available_packages() == ["mumps"], reason="MUMPS alone has a limit")
def test_auto_makes_more_factors_than_mpi_has_communicators():
    A, b, package = definite(), np.ones(N), choose_package("auto")
    factors = [sparse_cholesky(A, package) for _ in range(2500)]
    np.testing.assert_array_equal(factors[-1].solve(b), factors[0].solve(b))


@pytest.mark.parametrize(("package", "available", "message"), [
    ("auto", [], "'auto'.*neither CHOLMOD nor"),
    ("mumps", [], "'mumps'.*neither CHOLMOD nor"),
    ("mumps", ["cholmod"], r"'mumps'; available are \['cholmod'\]"),
])  # fmt: skip
def test_package_that_is_not_installed(package, available, message, monkeypatch):
    assert choose_package("auto") == available_packages()[0]
    monkeypatch.setattr(cholesky, "_is_available", lambda name: name in available)
    with pytest.raises(FactorizationError, match=message):
        choose_package(package)


@pytest.mark.skipif("MPICH" not in MPI.Get_library_version(), reason="Open MPI has no such limit")
def test_mumps_stops_before_communicators_run_out_and_goes_on_when_there_are_some():
    A, b = definite(), np.ones(N)
    factors = []
    with pytest.raises(FactorizationError, match="no communicators left"):
        for _ in range(2048):
            factors.append(sparse_cholesky(A, "mumps"))
    last = factors.pop().solve(b)
    factors.clear()
    np.testing.assert_array_equal(sparse_cholesky(A, "mumps").solve(b), last)


@pytest.mark.skipif("mumps" not in available_packages(), reason="this PETSc has no MUMPS")
def test_distributed_factor_on_one_rank():
    A, b = definite(), np.random.default_rng(1).standard_normal(N)
    x = DistributedCholesky(MPI.COMM_SELF, A).solve(b)
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), rtol=1e-12)


def cube_of_springs(n: int) -> sp.csr_matrix:
    """Return a definite matrix of n^3 unknowns, each coupled with up to 26 neighbours."""
    row = sp.diags([np.ones(n - 1), np.ones(n), np.ones(n - 1)], [-1, 0, 1])
    pattern = sp.kron(sp.kron(row, row), row).tocsr()
    return (28.0 * sp.identity(n**3) - pattern).tocsr()


@pytest.mark.skipif("cholmod" not in available_packages(), reason="PETSc without CHOLMOD")
def test_large_factors_are_smaller_by_the_ordering_of_metis():
    """Without it, which a user may ask for, they are larger; the option stays the user's."""
    options, name = PETSc.Options(), "mat_cholmod_nmethods"
    A = cube_of_springs(16)
    smallest = sparse_cholesky(A, "cholmod").entries
    assert not options.hasName(name)
    options[name] = 2
    try:
        assert smallest < 0.95 * sparse_cholesky(A, "cholmod").entries
        assert options.getInt(name) == 2
    finally:
        options.delValue(name)


@pytest.mark.skipif("cholmod" not in available_packages(), reason="PETSc without CHOLMOD")
def test_quick_factor_of_a_large_matrix_has_another_ordering():
    A = cube_of_springs(16)
    b = np.random.default_rng(0).standard_normal(A.shape[0])
    best, quick = sparse_cholesky(A, "cholmod"), sparse_cholesky(A, "cholmod", quick=True)
    assert best.entries < quick.entries < 1.5 * best.entries
    solution = best.solve(b)
    np.testing.assert_allclose(
        quick.solve(b), solution, rtol=0, atol=1e-12 * np.abs(solution).max()
    )


def indefinite(negative: int) -> sp.csr_matrix:
    """Return a matrix with a given number of negative eigenvalues."""
    values = np.linalg.eigvalsh(definite().toarray())
    shift = 0.5 * (values[negative - 1] + values[negative]) if negative else 0.0
    return (definite() - shift * sp.identity(N)).tocsr()


@pytest.mark.parametrize("negative", [0, 1, 7])
@pytest.mark.parametrize("package", [p for p in available_packages() if p != "cholmod"])
def test_indefinite_factor_has_the_inertia(package, negative, monkeypatch):
    monkeypatch.setattr(cholesky, "_is_available", lambda name: name == package)
    A, b = indefinite(negative), np.random.default_rng(1).standard_normal((N, 3))
    factor = sparse_ldl(A)
    assert factor.negative == negative
    np.testing.assert_allclose(factor.solve(b), np.linalg.solve(A.toarray(), b), rtol=1e-10)


def test_zero_diagonal_needs_pivots_of_order_two():
    A = sp.csr_matrix(np.array([[0.0, 1.0], [1.0, 0.0]]))
    factor = sparse_ldl(A)
    assert factor.negative == 1
    np.testing.assert_allclose(factor.solve(np.array([1.0, 2.0])), [2.0, 1.0])


@pytest.mark.parametrize("package", [p for p in available_packages() if p != "cholmod"])
def test_unknowns_without_a_diagonal(package, monkeypatch):
    """Lagrange multipliers: as many negative eigenvalues as there are."""
    monkeypatch.setattr(cholesky, "_is_available", lambda name: name == package)
    V = sp.random(N, 2, 0.3, random_state=0, format="csr")
    A = sp.bmat([[definite(), V], [V.T, None]], format="csr")
    factor, b = sparse_ldl(A), np.random.default_rng(1).standard_normal((N + 2, 3))
    assert factor.negative == 2
    np.testing.assert_allclose(factor.solve(b), np.linalg.solve(A.toarray(), b), rtol=1e-9)


def test_singular_matrix_has_no_indefinite_factor():
    with pytest.raises(FactorizationError, match="of order 40 is singular"):
        sparse_ldl(sp.diags(np.arange(N) - 5.0, format="csr"))


def test_cholmod_alone_has_no_indefinite_factor(monkeypatch):
    monkeypatch.setattr(cholesky, "_is_available", lambda name: name == "cholmod")
    with pytest.raises(FactorizationError, match="install a PETSc with MUMPS"):
        sparse_ldl(definite())


compiled = pytest.mark.skipif(
    "cholmod" not in available_packages() or supernodal_library()[0] is None,
    reason="no compiled solves",
)


@compiled
@pytest.mark.parametrize("columns", [0, 2])
@pytest.mark.parametrize("negative", [0, 1, 7])
def test_downdated_factor_has_the_inertia(negative, columns):
    random = np.random.default_rng(1)
    # soft directions, as those of rotations are
    values = np.append(np.full(negative, -0.01), np.linspace(1.0, 10.0, N - negative))
    vectors = np.linalg.qr(random.standard_normal((N, N)))[0]
    A = sp.csr_matrix((vectors * values) @ vectors.T)
    U, b = random.standard_normal((N, columns)), random.standard_normal((N, 3))
    expected = A.toarray() - U @ U.T
    factor = downdated_cholesky(A.copy(), U, "cholmod")
    assert factor.negative == np.count_nonzero(np.linalg.eigvalsh(expected) < 0.0)
    np.testing.assert_allclose(factor.solve(b), np.linalg.solve(expected, b), rtol=1e-9)
    np.testing.assert_allclose(factor.solve(b[:, 0]), factor.solve(b)[:, 0], rtol=1e-9)
    some = np.arange(3, N, 4)
    inverse = np.linalg.inv(expected)[np.ix_(some, some)]
    rows = random.standard_normal((2, some.size))
    np.testing.assert_allclose(factor.between(some)(rows), rows @ inverse, atol=1e-9)


@compiled
@pytest.mark.parametrize(("A", "U", "message"), [
    (indefinite(20), np.zeros((N, 0)), "a pivot is not positive"),
    (sp.identity(N, format="csr"), np.eye(N, 1), "downdated .* failed"),
], ids=["many negative eigenvalues", "singular"])  # fmt: skip
def test_what_is_not_downdated(A, U, message):
    with pytest.raises(FactorizationError, match=message):
        downdated_cholesky(A, U, "cholmod")


@compiled
def test_downdated_factor_of_a_matrix_without_a_diagonal_entry():
    """A spring is added to an entry that is not stored."""
    A = sp.csr_matrix(np.array([[2.0, 1.0], [1.0, 0.0]]))
    assert A.nnz == 3
    factor = downdated_cholesky(A, np.zeros((2, 0)), "cholmod")
    assert factor.negative == 1
    np.testing.assert_allclose(factor.solve(np.array([3.0, 1.0])), [1.0, 1.0], rtol=1e-14)


def test_downdated_factor_needs_compiled_solves(monkeypatch):
    monkeypatch.setattr(cholesky, "supernodal_library", lambda: (None, "no compiler"))
    with pytest.raises(FactorizationError, match="compiled solves"):
        downdated_cholesky(definite(), np.zeros((N, 0)), "cholmod")


WITHOUT_MEMORY = """
import resource, sys
import numpy as np, scipy.sparse as sp
from fenics_tfeti import OutOfMemory
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky

package, quick = sys.argv[1], sys.argv[2] == "quick"
T, I = sp.diags([-1, 2.1, -1], [-1, 0, 1], shape=(32, 32)), sp.identity(32)
A = sum(sp.kron(sp.kron(a, b), c) for a, b, c in ((T, I, I), (I, T, I), (I, I, T))).tocsr()
sparse_cholesky(2 * sp.identity(100, format="csr"), package, quick)
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + 2**24, resource.RLIM_INFINITY))
try:
    sparse_cholesky(A, package, quick)
except OutOfMemory as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits on memory are those of Linux")
@pytest.mark.parametrize("kind", ["quick", "whole"])
@pytest.mark.parametrize("package", sorted({"cholmod", "mumps"} & {*available_packages()}))
def test_factor_without_memory_is_told(package, kind):
    message = f"there is not enough memory for the factor of a matrix of order 32768 by {package}"
    assert message in run_python(WITHOUT_MEMORY, package, kind)
