"""Projections onto sets of forces with friction, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.qp import FrictionCones, least_norm, smallest_factor

pytestmark = pytest.mark.once


def cones(d: int, rng=None, k: int = 40) -> FrictionCones:
    """Return random sets on 2 + k (1 + d) + 1 components; some have m = 0, r = 0, or both."""
    rng = rng or np.random.default_rng(0)
    normal = 2 + np.arange(k)
    tangential = 2 + k + np.arange(d * k).reshape(k, d)
    radius, slope = rng.random((2, k)) * (rng.random((2, k)) < 0.7)
    return FrictionCones(np.array([0, 1]), normal, tangential, radius, slope)


def contains(cone: FrictionCones, x, rounding=1e-12) -> bool:
    size = np.linalg.norm(x[cone.tangential], axis=1)
    n = x[cone.normal]
    below = np.append(n, x[cone.below])
    return bool(np.all(below >= 0.0) and np.all(size <= cone.radius + cone.slope * n + rounding))


@pytest.mark.parametrize("d", [1, 2])
def test_projection_is_the_nearest_point(d):
    """Its difference makes an obtuse angle with the way to any point of the convex set."""
    rng = np.random.default_rng(d)
    cone = cones(d)
    size = 3 + 40 * (1 + d)
    for _ in range(20):
        x = 2.0 * rng.standard_normal(size)
        y = cone.project(x.copy())
        assert contains(cone, y)
        np.testing.assert_allclose(cone.project(y.copy()), y, atol=1e-12)
        assert y[-1] == x[-1]
        for _ in range(20):
            other = cone.project(3.0 * rng.standard_normal(size))
            # block by block
            blocks = np.concatenate([cone.normal[:, None], cone.tangential], axis=1)
            turn = np.sum((x - y)[blocks] * (other - y)[blocks], axis=1)
            assert turn.max() <= 1e-12


@pytest.mark.parametrize("d", [1, 2])
def test_derivative_is_that_of_differences(d):
    rng = np.random.default_rng(10 + d)
    cone, size, step = cones(d), 3 + 40 * (1 + d), 1e-6
    for _ in range(10):
        x, columns = 2.0 * rng.standard_normal(size), rng.standard_normal((size, 3))
        found = cone.derivative_times(x, columns)
        for k in range(3):
            ahead, behind = (cone.project(x + s * step * columns[:, k]) for s in (1, -1))
            expected = (ahead - behind) / (2.0 * step)
            # but for the few blocks that are within a step of an edge
            wrong = np.abs(found[:, k] - expected) > 1e-5
            assert np.count_nonzero(wrong) <= 2 * (1 + d)


@pytest.mark.parametrize("d", [1, 2])
def test_sparse_derivative(d):
    cone, size = cones(d), 3 + 40 * (1 + d)
    x = 2.0 * np.random.default_rng(20 + d).standard_normal(size)
    expected = cone.derivative_times(x, np.identity(size))
    np.testing.assert_allclose(cone.derivative(x).toarray(), expected, atol=1e-15)


@pytest.mark.parametrize(("push", "factor"), [(0.29, 1.0), (0.31, 0.31 / 0.3)])
def test_weight_on_rough_ground(push, factor):
    """Two feet of coefficient 0.3 under a weight of 1 hold a push of 0.3 and no more."""
    C = np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 1.0, 0.0], 6 * [0.0]])
    C[2, 3] = C[2, 5] = 1.0
    feet = FrictionCones(
        np.zeros(0, int),
        np.array([0, 1]),
        np.array([[2, 3], [4, 5]]),
        np.zeros(2),
        0.3 * np.ones(2),
    )
    load = np.array([1.0, push * 0.6, push * 0.8])
    x, residual = least_norm(C, load, feet)
    assert contains(feet, x, 1e-9)
    assert (np.linalg.norm(residual) < 1e-9) == (factor == 1.0)
    assert smallest_factor(C, load, feet) == pytest.approx(push / 0.3, rel=2e-4)
    sparse, rest = least_norm(sp.csr_matrix(C), load, feet)
    # without a solution the smallest residual is a limit, to which the regularisations differ
    accuracy = 1e-9 if factor == 1.0 else 1e-5
    np.testing.assert_allclose(sparse, x, rtol=0.0, atol=accuracy)
    np.testing.assert_allclose(rest, residual, rtol=0.0, atol=accuracy)


def test_ground_that_is_not_pressed_holds_nothing():
    C = np.array([[0.0, 1.0]])
    foot = FrictionCones(np.zeros(0, int), np.array([0]), np.array([[1]]), np.zeros(1), np.ones(1))
    x, _ = least_norm(C, np.array([1.0]), foot)
    # nothing asks for the normal force, which comes at no cost to the balance
    assert x[1] == pytest.approx(1.0)
    assert x[0] >= 1.0 - 1e-9
