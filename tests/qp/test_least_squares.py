"""Signed least squares problems with rows and columns of any length, also zero."""

from __future__ import annotations

import numpy as np
import pytest
from daqp import solve as daqp_solve
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from fenics_tfeti.qp.least_squares import (
    least_distance,
    least_norm_nonnegative,
    least_norm_partly_nonnegative,
    nonnegative_least_squares,
)

pytestmark = pytest.mark.once

seeds = st.integers(0, 2**32 - 1)
decades = st.sampled_from([0, 3, 6])


def scales(rng, count: int, decades: int):
    """Return factors over some decades, about every eighth of them zero."""
    factors = 10.0 ** rng.uniform(-decades, decades, count)
    return np.where(rng.random(count) < 0.125, 0.0, factors)


@settings(max_examples=200, deadline=None)
@given(seeds, decades)
def test_a_solution_that_exists_is_found(seed, decades):
    rng = np.random.default_rng(seed)
    r, n = rng.integers(1, 7), rng.integers(0, 40)
    C = rng.standard_normal((r, n)) * scales(rng, n, decades)
    C[rng.random(r) < 0.125] = 0.0
    d = C @ (rng.random(n) * (rng.random(n) < 0.5))
    x, residual = least_norm_nonnegative(C, d)
    assert np.all(x >= 0.0) and np.linalg.norm(residual) <= 1e-9 * np.linalg.norm(d)
    np.testing.assert_allclose(d - C @ x, residual, atol=1e-12 * np.linalg.norm(d))


@settings(max_examples=200, deadline=None)
@given(seeds, decades)
def test_what_has_no_solution_is_certified(seed, decades):
    """C'y <= o and d'y > 0 for a y: Farkas' lemma, with the residual as the y that is found."""
    rng = np.random.default_rng(seed)
    r, n = rng.integers(1, 7), rng.integers(0, 40)
    y = rng.standard_normal(r)
    y /= np.linalg.norm(y)
    C = rng.standard_normal((r, n))
    C -= np.outer(y, np.maximum(y @ C, 0.0))
    C = C * scales(rng, n, decades)
    d = y + 0.5 * rng.standard_normal(r)
    if d @ y <= 0.0:
        d = -d
    _, residual = least_norm_nonnegative(C, d)
    lengths = np.linalg.norm(C, axis=0)
    assert d @ residual > 0.0
    assert np.all(C.T @ residual <= 1e-9 * lengths * np.linalg.norm(d))


@settings(max_examples=200, deadline=None)
@given(seeds, decades)
def test_least_distance_does_not_depend_on_the_lengths_of_rows(seed, decades):
    rng = np.random.default_rng(seed)
    m, k = rng.integers(0, 20), rng.integers(1, 7)
    A, inside = rng.standard_normal((m, k)), rng.standard_normal(k)
    b = A @ inside + rng.random(m)
    factors = scales(rng, m, decades)
    A = np.where(factors[:, None] > 0.0, A, 0.0)
    b = np.where(factors > 0.0, b, rng.random(m))
    lower = np.full(m, -1e30)
    exact = np.zeros(k)
    if m:
        exact = daqp_solve(np.eye(k), np.zeros(k), A, b, lower, np.zeros(m, dtype=np.int32))[0]
    factors = np.where(factors > 0.0, factors, 1.0)
    z = least_distance(factors[:, None] * A, factors * b)
    np.testing.assert_allclose(z, exact, atol=1e-6)


def test_a_condition_that_is_far_away_does_not_spoil_the_others():
    A, b = np.array([[-1.0, 0.0], [1.0, 1.0]]), np.array([-1e-12, 1e10])
    np.testing.assert_allclose(least_distance(A, b), [1e-12, 0.0], rtol=1e-12, atol=1e-24)


@pytest.mark.parametrize("b", [-1.0, 1.0])
def test_a_row_of_no_length_is_a_condition_on_b(b):
    A = np.array([[0.0, 0.0], [-1.0, 0.0]])
    z = least_distance(A, np.array([b, -1.0]))
    np.testing.assert_allclose(z, [float(b > 0.0), 0.0])


@pytest.mark.parametrize("A", [np.zeros((3, 0)), np.zeros((3, 2)), np.full((3, 2), 1e-300)])
def test_columns_of_no_length_get_nothing_to_do(A):
    x = nonnegative_least_squares(A, np.array([0.0, 0.0, -1.0]))
    assert x.tolist() == [0.0] * A.shape[1]


def two_bodies(seed, size):
    """Return columns that press two bodies apart, small columns, load and gaps."""
    rng = np.random.default_rng(seed)
    pair = rng.normal(size=(6, 40))
    C, E = np.vstack([pair, -pair]), size * np.diag(rng.uniform(0.5, 2.0, size=12))
    return C, E, rng.normal(size=12), rng.exponential(size=40)


@pytest.mark.parametrize("size", [1e-2, 1e-4, 3e-7])
@pytest.mark.parametrize("seed", range(4))
def test_small_columns_share_with_nonnegative_ones(seed, size):
    """Compared with NNLS for x alone, p = E^{-1}(d - Cx): 1/2 ||x + g||^2 + 1/2 ||p||^2."""
    C, E, d, g = two_bodies(seed, size)
    x, residual = least_norm_partly_nonnegative(C, E, d, g)
    A = np.vstack([np.identity(40), np.linalg.solve(E, C)])
    expected = nnls(A, np.append(-g, np.linalg.solve(E, d)), maxiter=10_000)[0]
    assert (x >= 0.0).all()
    assert np.linalg.norm(residual) <= 1e-10 * np.linalg.norm(d)

    def value(x):
        p = np.linalg.solve(E, d - C @ x)
        return 0.5 * (x @ x + p @ p) + g @ x

    # what the bodies exchange is known to 1e-16 / size^2 only, but p^2 is flat there
    assert value(x) <= value(expected) * (1.0 + 1e-8)


def test_a_wide_gap_leaves_the_load_to_the_small_columns():
    C, E = np.array([[1.0], [-1.0]]), 1e-3 * np.identity(2)
    load = np.array([1.0, 0.0])
    assert least_norm_partly_nonnegative(C, E, load, np.zeros(1))[0] == pytest.approx(0.5, 1e-5)
    # apart by less than p / E = 1e6, and by more
    assert least_norm_partly_nonnegative(C, E, load, np.array([5e5]))[0] == pytest.approx(
        0.25, 1e-5
    )
    assert least_norm_partly_nonnegative(C, E, load, np.array([2e6]))[0].tolist() == [0.0]


def test_what_no_column_resists_is_left():
    C, E, d = np.array([[1.0], [0.0]]), np.array([[0.0], [0.0]]), np.array([-1.0, 0.0])
    x, residual = least_norm_partly_nonnegative(C, E, d, np.zeros(1))
    assert x.tolist() == [0.0]
    np.testing.assert_array_equal(residual, d)
