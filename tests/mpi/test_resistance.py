"""Motions that rows of several ranks resist: the same as those of one rank with all rows."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.resistance import sum_sparse, weak_motions

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("bodies", [5, 40])
def test_rows_on_several_ranks(bodies):
    """By dense algebra, and by inverse iteration."""
    rng = np.random.default_rng(0)
    # a chain of bodies that nothing holds, and one that is held in two modes
    rows = np.zeros((7 * bodies - 5, 6 * bodies + 6))
    for i in range(bodies - 1):
        block, at = slice(7 * i, 7 * i + 7), 6 * i
        rows[block, at : at + 6] = rng.standard_normal((7, 6))
        rows[block, at + 6 : at + 12] = -rows[block, at : at + 6]
    rows[-2:, -6:] = rng.standard_normal((2, 6))
    own = sp.csr_matrix(rows[COMM.rank :: COMM.size])
    values, z = weak_motions(COMM, own, np.zeros((bodies + 1, 6, 6)), 1e-4, 1e-12)
    dense = z.toarray()
    assert values.size == 6 + 4
    np.testing.assert_allclose(rows @ dense, 0.0, atol=1e-13)
    np.testing.assert_allclose(dense.T @ dense, np.eye(10), atol=1e-13)
    assert all(np.array_equal(dense, other) for other in COMM.allgather(dense))


def test_sum_of_sparse_matrices():
    own = sp.csr_matrix(np.diag([1.0, 0.0, COMM.rank]))
    expected = np.diag([COMM.size, 0.0, COMM.size * (COMM.size - 1) / 2])
    np.testing.assert_array_equal(sum_sparse(COMM, own).toarray(), expected)
