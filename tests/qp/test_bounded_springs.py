from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from daqp import solve as daqp_solve
from scipy.optimize import lsq_linear

from fenics_tfeti.qp import bounded_springs

pytestmark = pytest.mark.once


def cost(S: np.ndarray, gap: np.ndarray, z: np.ndarray) -> float:
    return float(np.sum(np.maximum(S @ z - gap, 0.0) ** 2))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e9])
@pytest.mark.parametrize("seed", range(4))
def test_smallest_sum_of_squares(seed, scale):
    """Against an independent solver: the smallest ||Sz + s - gap|| over z and s >= o."""
    rng = np.random.default_rng(seed)
    m, k = rng.integers(5, 40), rng.integers(1, 6)
    S, gap = rng.standard_normal((m, k)), rng.standard_normal(m)
    whole = np.hstack([S, np.identity(m)])
    lower = np.append(np.full(k, -np.inf), np.zeros(m))
    found = lsq_linear(whole, gap, (lower, np.inf), tol=1e-14, method="bvls")
    z = bounded_springs(sp.csr_matrix(scale * S), scale * gap)
    assert cost(S, gap, z) == pytest.approx(2 * found.cost, rel=1e-7, abs=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_weak_and_strong_rows(seed):
    """A position without penetration is found, whatever the lengths of the rows."""
    rng = np.random.default_rng(seed)
    S = rng.standard_normal((30, 5)) * 10.0 ** rng.uniform(-3, 0, 30)[:, None]
    inside = 10.0 * rng.standard_normal(5)
    gap = S @ inside + 0.01 * np.abs(S).max(axis=1) * rng.random(30)
    z = bounded_springs(sp.csr_matrix(S), gap)
    assert (S @ z - gap <= 1e-9 * np.linalg.norm(S, axis=1) * np.linalg.norm(inside)).all()


def test_nothing_penetrates():
    S = sp.csr_matrix(np.array([[1.0, 2.0]]))
    assert not bounded_springs(S, np.array([0.0])).any()
    assert bounded_springs(S[:, :0], np.array([-1.0])).size == 0
    assert not bounded_springs(S[:0], np.zeros(0)).any()


@pytest.mark.parametrize("seed", range(2))
def test_combinations_of_motions(seed):
    """S and a basis T instead of ST."""
    rng = np.random.default_rng(seed)
    S, T, gap = rng.standard_normal((30, 6)), rng.standard_normal((6, 4)), rng.standard_normal(30)
    z = bounded_springs(sp.csr_matrix(S), gap, basis=sp.csr_matrix(T))
    expected = bounded_springs(sp.csr_matrix(S @ T), gap)
    np.testing.assert_allclose(z, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("array", [np.asarray, sp.csr_matrix])
@pytest.mark.parametrize("seed", range(2))
def test_nearest_position_without_penetration(seed, array):
    """The solution of a quadratic programme."""
    rng = np.random.default_rng(seed)
    A, inside = rng.standard_normal((12, 4)), rng.standard_normal(4)
    b = A @ inside + rng.random(12)
    lower = np.full(12, -1e30)
    exact = daqp_solve(np.eye(4), np.zeros(4), A, b, lower, np.zeros(12, dtype=np.int32))[0]
    np.testing.assert_allclose(bounded_springs(array(A), b), exact, atol=1e-6)


def test_rows_without_common_solution_are_violated_alike():
    z = bounded_springs(np.array([[1.0], [-1.0]]), np.array([-1.0, -3.0]))
    np.testing.assert_allclose(z, [1.0], rtol=1e-9)


def test_gap_that_is_far_away_does_not_spoil_the_others():
    A, b = np.array([[-1.0, 0.0], [1.0, 1.0]]), np.array([-1e-12, 1e10])
    np.testing.assert_allclose(bounded_springs(A, b), [1e-12, 0.0], rtol=1e-9, atol=1e-24)
