"""Sparse factors by each package that PETSc has, against dense algebra."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti import FactorizationError
from fenics_tfeti.feti.local import cholesky
from fenics_tfeti.feti.local.cholesky import (
    DistributedCholesky,
    SparseCholesky,
    available_packages,
    choose_package,
)

N = 40
each_package = pytest.mark.parametrize("package", available_packages())


def definite(seed: int = 0) -> sp.csr_matrix:
    """Return a sparse symmetric positive definite matrix of order N."""
    A = sp.random(N, N, density=0.1, random_state=seed, format="csr")
    return (A @ A.T + sp.identity(N)).tocsr()


@each_package
def test_one_right_hand_side(package):
    A, b = definite(), np.random.default_rng(1).standard_normal(N)
    x = SparseCholesky(A, package).solve(b)
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), rtol=1e-12)


@each_package
@pytest.mark.parametrize("columns", [1, 3, 64, 65, 130])
def test_many_right_hand_sides(package, columns):
    A, b = definite(), np.random.default_rng(1).standard_normal((N, columns))
    x = SparseCholesky(A, package).solve(b)
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), rtol=0.0, atol=1e-12)


@each_package
def test_solutions_are_not_overwritten_by_the_next(package):
    factor = SparseCholesky(definite(), package)
    first = factor.solve(np.ones(N))
    kept = first.copy()
    factor.solve(np.zeros(N))
    np.testing.assert_array_equal(first, kept)


@each_package
def test_factor_of_a_tridiagonal_matrix_has_no_fill(package):
    ones = np.ones(N - 1)
    A = sp.diags([-ones, np.full(N, 3.0), -ones], [-1, 0, 1], format="csr")
    assert 2 * N - 1 <= SparseCholesky(A, package).entries <= 3 * N


@each_package
@pytest.mark.parametrize(
    "matrix",
    [-definite(), sp.diags(np.arange(N, dtype=float), format="csr")],
    ids=["negative definite", "singular"],
)
def test_matrix_that_is_not_positive_definite_is_refused(package, matrix):
    with pytest.raises(FactorizationError, match="of order 40 is not positive definite"):
        SparseCholesky(matrix, package)


def test_auto_takes_the_first_package():
    assert choose_package("auto") == available_packages()[0]


def test_package_that_petsc_does_not_have(monkeypatch):
    monkeypatch.setattr(cholesky, "available_packages", lambda: [])
    for package in ("auto", "mumps"):
        with pytest.raises(FactorizationError, match=f"'{package}'"):
            choose_package(package)


@pytest.mark.skipif("mumps" not in available_packages(), reason="this PETSc has no MUMPS")
def test_distributed_factor_on_one_rank():
    A, b = definite(), np.random.default_rng(1).standard_normal(N)
    x = DistributedCholesky(MPI.COMM_SELF, A).solve(b)
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), rtol=1e-12)
