"""Groups of sparse columns: their bases and pivots, against dense algebra."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.linalg import qr

from fenics_tfeti.feti.coarse.column_groups import (
    column_groups,
    of_one_body,
    orthonormal_columns,
    pivot_rows,
)

pytestmark = pytest.mark.once

COLUMNS = sp.csr_matrix(
    np.array([[1.0, 0, 0], [2.0, 0, 0], [0, 3.0, 1.0], [0, 0, 0], [0, -4.0, 1.0]])
)


def test_column_groups():
    one, two = column_groups(sp.block_diag([COLUMNS, COLUMNS], format="csr"))
    assert one.rows.tolist() == [[0, 1], [5, 6]] and one.columns.tolist() == [[0], [3]]
    assert two.rows.tolist() == [[2, 4], [7, 9]] and two.columns.tolist() == [[1, 2], [4, 5]]
    np.testing.assert_array_equal(two.dense[1], [[3.0, 1.0], [-4.0, 1.0]])


NO_OTHERS = sp.csr_matrix((5, 0))
# shares rows with both groups
OTHER = sp.csr_matrix(np.array([[1.0], [1.0], [1.0], [2.0], [5.0]]))
with_others = pytest.mark.parametrize("others", [NO_OTHERS, OTHER])


@with_others
def test_orthonormal_columns_have_the_same_range_and_no_more_entries(others):
    Q = orthonormal_columns(COLUMNS, others)
    dense, span = Q.toarray(), sp.hstack([COLUMNS, others]).toarray()
    np.testing.assert_allclose(dense.T @ dense, np.eye(span.shape[1]), atol=1e-15)
    np.testing.assert_allclose(dense @ (dense.T @ span), span, atol=1e-14)
    assert Q[:, :3].nnz == 6


@with_others
def test_pivot_rows_are_independent(others):
    rows = pivot_rows(COLUMNS, others)
    assert sorted(rows[:3].tolist()) == [1, 2, 4]
    square = sp.hstack([COLUMNS, others]).toarray()[rows]
    assert np.linalg.cond(square) < 30.0


def test_pivot_rows_are_those_of_a_factorisation_with_pivoting():
    Q = np.linalg.qr(np.random.default_rng(5).standard_normal((30, 7)))[0]
    expected = qr(Q.T, mode="r", pivoting=True)[1][:7].tolist()
    none = sp.csr_matrix((30, 0))
    assert pivot_rows(sp.csr_matrix(Q), none).tolist() == expected
    assert pivot_rows(none, sp.csr_matrix(Q)).tolist() == expected


def test_motions_of_one_body():
    z = np.zeros((4 * 6, 3))
    z[6, 0] = z[11, 0] = z[18, 1] = z[0, 2] = z[6, 2] = 1.0
    assert of_one_body(sp.csc_matrix(z), 6).tolist() == [True, True, False]


@pytest.mark.parametrize("function", [orthonormal_columns, pivot_rows])
def test_no_columns(function):
    none = sp.csr_matrix((4, 0))
    assert function(none, none).shape[-1] == 0
