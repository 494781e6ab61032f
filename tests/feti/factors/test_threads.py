"""Libraries work on the calling thread only, also those that ask for more."""

from mpi4py import MPI  # noqa: F401  first, or the wheels' petsc4py does not find the MPI library

from petsc4py import PETSc

import pytest
from new_process import run_python

from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.factors.threads import one_thread, openmp

FACTOR = """
import os
import numpy as np, scipy.sparse as sp
from fenics_tfeti.feti.factors.cholesky import sparse_cholesky
def number():
    return len(os.listdir("/proc/self/task"))
n = 12  # a cube of nodes: large enough for supernodes
line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], (n, n))
A = sp.kronsum(sp.kronsum(line, line), line) + sp.identity(n**3)
before = number()
sparse_cholesky(A.tocsr(), "cholmod")
print(number() - before)
"""


@pytest.mark.skipif("cholmod" not in available_packages(), reason="CHOLMOD is not installed")
def test_a_factorisation_starts_no_threads(monkeypatch):
    # BLAS obeys it
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert run_python(FACTOR) == "0"


@pytest.mark.skipif(openmp(PETSc.__file__) is None, reason="PETSc's packages do not use OpenMP")
def test_the_levels_of_parallel_regions_are_put_back():
    library = openmp(PETSc.__file__)
    before = library.omp_get_max_active_levels()
    with pytest.raises(RuntimeError, match="wrong"), one_thread():
        assert library.omp_get_max_active_levels() == 0
        raise RuntimeError("wrong")
    assert library.omp_get_max_active_levels() == before


def test_nothing_happens_without_openmp():
    assert openmp("libc.so.6") is None
    with one_thread("libc.so.6"):
        pass
