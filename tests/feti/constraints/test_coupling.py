"""The factor of W against dense pseudoinverses, and groups of rows that depend on each other."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.feti.constraints.coupling import RowInverse, dependent_groups, null_space

pytestmark = pytest.mark.once


def random_gram(rng, rows: int, columns: int, terms: int) -> sp.csr_matrix:
    """Return the Gram matrix of sparse rows of unit length; some repeat combinations of others."""
    C = np.zeros((rows, columns))
    for row in C:
        row[rng.choice(columns, terms, replace=False)] = rng.normal(size=terms)
    for k in range(2, rows, 7):
        C[k] = rng.normal() * C[k - 1] + rng.normal() * C[k - 2]
    C /= np.linalg.norm(C, axis=1)[:, None]
    W = C @ C.T
    W[np.abs(W) < 1e-15] = 0.0
    np.fill_diagonal(W, 1.0)
    return sp.csr_matrix(W)


def chain(rows: int) -> sp.csr_matrix:
    """Return the Gram matrix of rows that each share a column with the next one."""
    off = np.full(rows - 1, 0.5)
    return sp.diags([off, np.ones(rows), off], [-1, 0, 1], format="csr")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("columns", "terms"), [(200, 3), (60, 4), (12, 3)])
def test_inverse_is_the_pseudoinverse_of_the_chosen_rows(seed, columns, terms):
    rng = np.random.default_rng(seed)
    W = random_gram(rng, 40, columns, terms)
    chosen = rng.random(40) < rng.choice([0.3, 0.7, 1.0])
    inverse = RowInverse.build(W, chosen, dependent_groups(W))
    found = np.stack([inverse.solve(unit) for unit in np.eye(40)], axis=1)
    at = np.ix_(chosen, chosen)
    expected = np.zeros((40, 40))
    expected[at] = np.linalg.pinv(W.toarray()[at], rcond=1e-11, hermitian=True)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("columns", [200, 60, 12])
def test_groups_contain_the_null_vectors(seed, columns):
    W = random_gram(np.random.default_rng(seed), 40, columns, 3)
    groups = dependent_groups(W)
    dense = W.toarray()
    null = null_space(dense)
    within = sum(null_space(dense[np.ix_(g, g)]).shape[1] for g in groups)
    assert within == null.shape[1] == 40 - np.linalg.matrix_rank(dense, tol=1e-11)
    outside = np.setdiff1d(np.arange(40), np.concatenate([[], *groups]).astype(int))
    assert np.abs(null[outside]).max(initial=0.0) <= 1e-9


def test_rows_of_different_groups_depend_on_nothing_in_common():
    W = sp.block_diag([chain(5), np.ones((2, 2)), chain(3), np.ones((3, 3))], format="csr")
    assert [g.tolist() for g in dependent_groups(W)] == [[5, 6], [10, 11, 12]]


def test_no_rows_and_no_chosen_rows():
    assert dependent_groups(sp.csr_matrix((0, 0))) == []
    W = chain(3)
    assert not RowInverse.build(W, np.zeros(3, dtype=bool)).solve(np.ones(3)).any()


def test_long_blocks_are_not_treated_as_dense_ones():
    """A block of 1e5 rows would take 80 GB."""
    rows = 100_000
    block = chain(rows).tolil()
    # the last but one row twice
    W = sp.bmat([[block, block[:, rows - 2]], [block[rows - 2], sp.identity(1)]], format="csr")
    groups = dependent_groups(W)
    assert [g.tolist() for g in groups] == [[rows - 2, rows]]
    y = np.random.default_rng(0).normal(size=rows + 1)
    y[rows] = y[rows - 2]
    found = RowInverse.build(W, np.ones(rows + 1, dtype=bool), groups).solve(W @ y)
    np.testing.assert_allclose(found, y, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(W @ found, W @ y, rtol=0.0, atol=1e-10)
