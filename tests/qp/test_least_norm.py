"""The smallest point of a product set with Cx = d, and the smallest set that has one."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse as sp
from qp_problems import Problem
from scipy.optimize import minimize, nnls, root

from fenics_tfeti.qp import (
    Bounds,
    Discs,
    ProductSet,
    bounded_springs,
    least_norm,
    smallest_factor,
)

pytestmark = pytest.mark.once

seeds = st.integers(0, 2**32 - 1)
decades = st.sampled_from([0, 3, 6])


def random_set(rng, half_lines: int = 5, intervals: int = 3, discs: int = 4) -> ProductSet:
    """Return half-lines from 0 on, intervals and discs around 0, and a line."""
    n = half_lines + intervals
    lower = np.append(np.zeros(half_lines), -rng.random(intervals))
    upper = np.append(np.full(half_lines, np.inf), rng.random(intervals))
    at = n + np.arange(2 * discs).reshape(-1, 2)
    return ProductSet(
        Bounds(np.arange(n), lower, upper), Discs(at, np.zeros(at.shape), rng.random(discs))
    )


@hypothesis.given(
    seed=st.integers(0, 10**6), rows=st.integers(1, 5), scale=st.sampled_from([1e-9, 1.0, 1e9])
)
def test_solution_against_the_dual_problem(seed, rows, scale):
    """x = P(C'y) of the y with Cx = d, by general solvers of equations and of minima."""
    rng = np.random.default_rng(seed)
    feasible, C = random_set(rng), rng.standard_normal((rows, 17))
    bounds = feasible.bounds
    lower, upper = np.full((2, 17), [[-np.inf], [np.inf]])
    lower[:8], upper[:8] = bounds.lower, bounds.upper
    nearest = Problem(np.eye(17), np.zeros(17), lower, upper=upper, discs=feasible.discs).nearest
    d = C @ nearest(rng.standard_normal(17))
    x, residual = least_norm(scale * C, scale * d, feasible)
    assert np.linalg.norm(residual) <= 1e-9 * scale * np.linalg.norm(d)
    np.testing.assert_allclose(feasible.project(x.copy()), x, atol=1e-13)

    def dual(y):
        z = nearest(C.T @ y)
        return y @ (C @ z - d) - 0.5 * z @ z, C @ z - d

    start = minimize(dual, np.zeros(rows), jac=True, method="BFGS", tol=1e-10).x
    oracle = root(lambda y: dual(y)[1], start, tol=1e-14)
    hypothesis.assume(np.linalg.norm(oracle.fun) <= 1e-13)
    np.testing.assert_allclose(x, nearest(C.T @ oracle.x), atol=1e-9)


@hypothesis.given(seed=st.integers(0, 10**6))
def test_residual_certifies_that_there_is_no_solution(seed):
    """residual'd is more than residual'Cx of any x of the set."""
    rng = np.random.default_rng(seed)
    feasible, C = random_set(rng, half_lines=0), rng.standard_normal((3, 11))
    d = 100.0 * rng.standard_normal(3)
    _, residual = least_norm(C, d, feasible)
    v = C.T @ residual
    farthest = np.maximum(v[:3] * feasible.bounds.lower, v[:3] * feasible.bounds.upper).sum()
    farthest += feasible.discs.radius @ np.linalg.norm(v[3:].reshape(-1, 2), axis=1)
    assert residual @ d > farthest * (1.0 + 1e-9)


def test_nothing_to_balance():
    feasible = random_set(np.random.default_rng(0))
    x, residual = least_norm(np.ones((2, 17)), np.zeros(2), feasible)
    assert not x.any()
    assert not residual.any()
    x, residual = least_norm(np.zeros((1, 17)), np.ones(1), feasible)
    assert not x.any()
    assert residual.tolist() == [1.0]


@pytest.mark.parametrize("push", [1e-3, 1e3])
def test_factor_is_the_push_over_what_the_radii_hold(push):
    """Two discs of radii 0.2 and 0.3 along the push, and one that the push does not reach."""
    discs = Discs(np.arange(6).reshape(3, 2), np.zeros((3, 2)), np.array([0.2, 0.3, 9.0]))
    C = np.array([[0.6, 0.8, 1.0, 0.0, 0.0, 0.0]])
    found = smallest_factor(C, np.array([push]), ProductSet(discs=discs))
    assert found == pytest.approx(push / 0.5, rel=2e-4)


def test_no_factor_is_enough_where_only_half_lines_resist():
    feasible = ProductSet(
        Bounds.from_below(np.array([0]), np.zeros(1)),
        random_set(np.random.default_rng(0), half_lines=1, intervals=0, discs=1).discs,
    )
    assert smallest_factor(np.array([[1.0, 0.0, 0.0]]), np.array([-1.0]), feasible) == np.inf


def scales(rng, count: int, decades: int):
    """Return factors over some decades, about every eighth of them zero."""
    factors = 10.0 ** rng.uniform(-decades, decades, count)
    return np.where(rng.random(count) < 0.125, 0.0, factors)


@hypothesis.given(seeds, decades)
def test_a_solution_that_exists_is_found(seed, decades):
    rng = np.random.default_rng(seed)
    r, n = rng.integers(1, 7), rng.integers(0, 40)
    C = rng.standard_normal((r, n)) * scales(rng, n, decades)
    C[rng.random(r) < 0.125] = 0.0
    d = C @ (rng.random(n) * (rng.random(n) < 0.5))
    x, residual = least_norm(C, d)
    assert np.all(x >= 0.0) and np.linalg.norm(residual) <= 1e-9 * np.linalg.norm(d)
    np.testing.assert_allclose(d - C @ x, residual, atol=1e-12 * np.linalg.norm(d))


@hypothesis.given(seeds, decades)
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
    _, residual = least_norm(C, d)
    lengths = np.linalg.norm(C, axis=0)
    assert d @ residual > 0.0
    assert np.all(C.T @ residual <= 1e-9 * lengths * np.linalg.norm(d))


def two_bodies(seed, size):
    """Return columns that press two bodies apart, small columns, load and gaps."""
    rng = np.random.default_rng(seed)
    pair = rng.normal(size=(6, 40))
    C, E = np.vstack([pair, -pair]), size * np.diag(rng.uniform(0.5, 2.0, size=12))
    return C, E, rng.normal(size=12), rng.exponential(size=40)


@pytest.mark.parametrize("size", [1e-2, 1e-4, 3e-7])
@pytest.mark.parametrize("seed", range(2))
def test_small_columns_share_with_nonnegative_ones(seed, size):
    """Compared with NNLS for x alone, p = E^{-1}(d - Cx): 1/2 ||x + g||^2 + 1/2 ||p||^2."""
    C, E, d, g = two_bodies(seed, size)
    x, residual = least_norm(C, d, springs=E, gap=g)
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
    assert least_norm(C, load, springs=E, gap=np.zeros(1))[0] == pytest.approx(0.5, 1e-5)
    # apart by less than p / E = 1e6, and by more
    assert least_norm(C, load, springs=E, gap=np.array([5e5]))[0] == pytest.approx(0.25, 1e-5)
    assert least_norm(C, load, springs=E, gap=np.array([2e6]))[0].tolist() == [0.0]


def test_what_no_column_resists_is_left():
    C, E, d = np.array([[1.0], [0.0]]), np.array([[0.0], [0.0]]), np.array([-1.0, 0.0])
    x, residual = least_norm(C, d, springs=E, gap=np.zeros(1))
    assert x.tolist() == [0.0]
    np.testing.assert_array_equal(residual, d)


@pytest.mark.parametrize("seed", range(3))
def test_rows_of_many_lengths(seed):
    """Each row is balanced relative to its own length."""
    rng = np.random.default_rng(seed)
    feasible, lengths = random_set(rng), 10.0 ** -np.arange(0.0, 8.0, 2.0)
    C = rng.standard_normal((4, 17)) * lengths[:, None]
    d = C @ feasible.project(rng.standard_normal(17))
    x, residual = least_norm(C, d, feasible)
    np.testing.assert_allclose(feasible.project(x.copy()), x, atol=1e-13)
    assert (np.abs(residual) <= 1e-9 * lengths).all()


@pytest.mark.parametrize("gap", [1e3, 1e9, 1e15])
def test_load_that_only_a_far_row_holds(gap):
    C, d = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([1.0, 1e-6])
    x, residual = least_norm(C, d, gap=np.array([0.0, gap]))
    np.testing.assert_allclose(x, [1.0 - 1e-6, 1e-6], rtol=1e-9)
    assert np.abs(residual).max() <= 1e-15


def test_many_sparse_rows():
    """Blocks on each other, held by those below: as dense."""
    n = 40
    C = np.eye(n) - np.eye(n, k=1)
    C, d = np.hstack([C, -C]), np.linspace(1.0, 2.0, n)
    x, residual = least_norm(sp.csr_matrix(C), d)
    expected, _ = least_norm(C, d)
    np.testing.assert_allclose(x, expected, atol=1e-9)
    assert np.linalg.norm(residual) <= 1e-12 * np.linalg.norm(d)


@pytest.mark.parametrize("columns", [0, 3])
@pytest.mark.parametrize("kind", [np.asarray, sp.csr_matrix])
def test_columns_that_resist_nothing(kind, columns):
    """The load is left as it is."""
    load = np.array([1.0, -2.0])
    x, residual = least_norm(kind(np.zeros((2, columns))), load)
    assert not x.any()
    np.testing.assert_array_equal(residual, load)


@pytest.mark.parametrize("kind", [np.asarray, sp.csr_matrix])
def test_load_without_springs_moves_along_itself(kind):
    load = np.array([1.0, -2.0])
    z = bounded_springs(kind(np.zeros((0, 2))), np.zeros(0), load=load)
    np.testing.assert_allclose(z / np.linalg.norm(z), load / np.linalg.norm(load), rtol=1e-12)


@pytest.mark.parametrize("form", [np.asarray, sp.csr_matrix])
@pytest.mark.parametrize("last", [0.0, 2.0])
def test_rows_that_vanish_balance_nothing(form, last):
    """Their part of the right-hand side is left, in dense and sparse matrices."""
    C = form([[0.0, 0.0, 0.0], [0.0, last, 0.0]])
    x, residual = least_norm(C, np.array([1.0, 4.0]))
    expected = 0.0 if last == 0.0 else 4.0 / last
    np.testing.assert_allclose(x, [0.0, expected, 0.0], atol=1e-12)
    np.testing.assert_allclose(residual, [1.0, 4.0 - last * expected], atol=1e-12)
