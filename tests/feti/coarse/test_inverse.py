"""The inverse of a coarse matrix by rows and its changes, against dense algebra."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.errors import FactorizationError
from fenics_tfeti.feti.coarse.factor import CoarseLayout
from fenics_tfeti.feti.coarse.inverse import InverseByRows, independent_columns
from fenics_tfeti.feti.local.cholesky import choose_package

SIZE = 12
RANDOM = np.random.default_rng(0)
G = sp.random(SIZE, 40, density=0.4, random_state=0, format="csc")
B = RANDOM.standard_normal((SIZE, 3))
WHOLE = (G @ G.T).tocsr()
NOTHING = sp.csc_matrix((SIZE, 0))
NO_PINS = np.zeros(SIZE)
PINS = np.zeros(SIZE)
PINS[[2, 7]] = 3.0


def inverse(columns: sp.csc_matrix = G, pins: np.ndarray = NO_PINS) -> InverseByRows:
    others = np.zeros(0, dtype=np.int64)
    layout = CoarseLayout.build(MPI.COMM_SELF, SIZE, others, "inverse", choose_package("auto"))
    return InverseByRows.build(layout, (columns @ columns.T).tocsr(), pins)


def dense(*columns: sp.csc_matrix, pins: np.ndarray = NO_PINS) -> np.ndarray:
    return sum((C @ C.T).toarray() for C in columns) + np.diag(pins)


CHANGES = {
    "none": (NOTHING, NOTHING, NO_PINS),
    "removed": (G[:, :6], NOTHING, NO_PINS),
    "added": (NOTHING, 2.0 * G[:, :6], NO_PINS),
    "pinned": (NOTHING, NOTHING, PINS),
    "all three": (G[:, 30:], G[:, :2], PINS),
}


@pytest.mark.parametrize("change", CHANGES)
def test_solutions_of_changed_matrices(change):
    removed, added, pins = CHANGES[change]
    gram = dense(G, added) - dense(removed)
    wanted = np.linalg.solve(gram + np.diag(pins), B)
    changed = inverse().changed(sp.csr_matrix(gram), removed, added, pins)
    np.testing.assert_allclose(changed.solve_columns(B), wanted, atol=1e-12)
    np.testing.assert_allclose(changed.solve(B[:, 0]), wanted[:, 0], atol=1e-12)


def test_pins_of_the_first_matrix_can_be_taken_out():
    wanted = np.linalg.solve(dense(G), B)
    changed = inverse(pins=PINS).changed(WHOLE, NOTHING, NOTHING, NO_PINS)
    np.testing.assert_allclose(changed.solve(B), wanted, atol=1e-12)


def test_changes_are_those_of_the_first_matrix():
    """They do not add up from face to face."""
    once = inverse().changed((G[:, 6:] @ G[:, 6:].T).tocsr(), G[:, :6], NOTHING, NO_PINS)
    twice = once.changed(WHOLE, NOTHING, NOTHING, NO_PINS)
    np.testing.assert_allclose(twice.solve(B), inverse().solve(B), atol=1e-14)


def test_rows_between_two_subdomains_are_few_columns():
    """Rows of contact of two faces that are plane: no more than six motions."""
    points = RANDOM.random((50, 2))
    normal = np.column_stack([np.ones(50), points])
    C = sp.csc_matrix(np.vstack([normal.T, -normal.T, np.zeros((3, 50))]))
    V = independent_columns(C)
    assert V.shape == (9, 3)
    np.testing.assert_allclose((V @ V.T).toarray(), (C @ C.T).toarray(), atol=1e-12)


def test_columns_of_different_subdomains_stay_apart():
    C = sp.block_diag([RANDOM.random((2, 5)), RANDOM.random((3, 5))], format="csc")
    V = independent_columns(C)
    assert V.shape == (5, 5)
    assert V.nnz == 2 * 2 + 3 * 3


@pytest.mark.parametrize("small", [1e-2, 1e-4, 1e-7])
def test_accuracy_does_not_depend_on_the_condition_of_the_first_matrix(small):
    C = G.copy()
    C[0] *= small
    firm = np.zeros(SIZE)
    firm[0] = 1e8
    gram = (C @ C.T).tocsr()
    changed = inverse(C).changed(gram, NOTHING, NOTHING, firm)
    r = B[:, 0] - (gram + sp.diags(firm)) @ changed.solve(B[:, 0])
    assert np.abs(r).max() < 1e-13


def test_a_singular_matrix_is_an_error():
    none = sp.csr_matrix((SIZE, SIZE))
    with pytest.raises(FactorizationError, match="not positive definite"):
        inverse().changed(none, G, NOTHING, NO_PINS)
