"""Friction cones: projection, its derivative, steps to the boundary, and MPGP on them."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.qp import (
    Bounds,
    FrictionCones,
    ProductSet,
    ProportioningOptions,
    least_norm,
    proportioning,
    smallest_factor,
)

pytestmark = pytest.mark.once


def cones(d: int, rng=None, k: int = 40) -> ProductSet:
    """Return random sets on 2 + k (1 + d) + 1 components; some have m = 0, r = 0, or both."""
    rng = rng or np.random.default_rng(0)
    normal = 2 + np.arange(k)
    tangential = 2 + k + np.arange(d * k).reshape(k, d)
    radius, slope = rng.random((2, k)) * (rng.random((2, k)) < 0.7)
    indices = np.column_stack([normal, tangential])
    bounds = Bounds.from_below(np.array([0, 1]), np.zeros(2))
    return ProductSet(bounds, cones=FrictionCones(indices, radius, slope))


def contains(feasible: ProductSet, x, rounding=1e-12) -> bool:
    cones = feasible.cones
    size = np.linalg.norm(x[cones.indices[:, 1:]], axis=1)
    n = x[cones.indices[:, 0]]
    below = np.append(n, x[feasible.bounds.indices])
    return bool(np.all(below >= 0.0) and np.all(size <= cones.radius + cones.slope * n + rounding))


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
            blocks = cone.cones.indices
            turn = np.sum((x - y)[blocks] * (other - y)[blocks], axis=1)
            assert turn.max() <= 1e-12


@pytest.mark.parametrize("d", [1, 2])
def test_derivative_is_that_of_differences(d):
    rng = np.random.default_rng(10 + d)
    cone, size, step = cones(d), 3 + 40 * (1 + d), 1e-6
    for _ in range(10):
        x, columns = 2.0 * rng.standard_normal(size), rng.standard_normal((size, 3))
        found = cone.derivative(x) @ columns
        for k in range(3):
            ahead, behind = (cone.project(x + s * step * columns[:, k]) for s in (1, -1))
            expected = (ahead - behind) / (2.0 * step)
            # but for the few blocks that are within a step of an edge
            wrong = np.abs(found[:, k] - expected) > 1e-5
            assert np.count_nonzero(wrong) <= 2 * (1 + d)


@pytest.mark.parametrize("d", [1, 2])
def test_longest_step_ends_on_the_boundary(d):
    """Of single cones, so that each kind of end occurs: on the side, at n = 0, and none."""
    rng, infinite = np.random.default_rng(30 + d), 0
    for _ in range(500):
        radius, slope = rng.random((2, 1)) * (rng.random((2, 1)) < 0.7)
        feasible = ProductSet(cones=FrictionCones(np.arange(1 + d)[None], radius, slope))
        x = feasible.project(2.0 * rng.standard_normal(1 + d))
        p = rng.standard_normal(1 + d)
        step = feasible.longest_step(x, p)
        infinite += step == np.inf
        for length in (0.5 * step, step) if np.isfinite(step) else (1e3,):
            y = x - length * p
            np.testing.assert_allclose(feasible.project(y.copy()), y, rtol=1e-11, atol=1e-11)
        if np.isfinite(step):
            y = x - (step + 1e-6) * p
            assert np.linalg.norm(feasible.project(y.copy()) - y) > 0.0
    assert 10 < infinite < 200


@pytest.mark.parametrize(("x", "p", "step"), [
    ([1.0, 0.5], [1.0, 0.0], 0.5),
    ([1.0, 0.5], [0.0, -1.0], 0.5),
    ([1.0, 0.5], [-1.0, -1.0], np.inf),
    ([1.0, 0.0], [1.0, 0.0], 1.0),
    ([0.0, 0.0], [-2.0, -1.0], np.inf),
    ([0.0, 0.0], [-1.0, -2.0], 0.0),
    ([0.0, 0.0], [0.0, 0.0], np.inf),
])  # fmt: skip
def test_longest_step_by_hand(x, p, step):
    cone = FrictionCones(np.array([[0, 1]]), np.zeros(1), np.ones(1))
    assert cone.longest_step(np.array(x), np.array(p)) == step


@pytest.mark.parametrize("d", [1, 2])
def test_minimum_on_cones_is_the_projected_step_from_itself(d):
    rng = np.random.default_rng(40 + d)
    feasible, size = cones(d, k=8), 3 + 8 * (1 + d)
    basis = np.linalg.qr(rng.standard_normal((size, size)))[0]
    A, unbounded = (basis * np.geomspace(1.0, 1e-2, size)) @ basis.T, rng.standard_normal(size)
    unbounded[feasible.cones.indices[:, 0]] += 0.5
    b = A @ unbounded
    result = proportioning(
        lambda x: (A @ x, None),
        b,
        feasible,
        np.zeros(size),
        lambda split: split.gradient_norm <= 1e-11,
        options=ProportioningOptions(step_length=1.9),
    )
    assert result.converged
    x = result.x
    np.testing.assert_allclose(feasible.project(x - A @ x + b), x, atol=1e-10)
    on_boundary = np.isin(feasible.cones.indices[:, 0], feasible.on_boundary(x))
    assert 0 < np.count_nonzero(on_boundary) < 8


@pytest.mark.parametrize(("push", "factor"), [(0.29, 1.0), (0.31, 0.31 / 0.3)])
def test_weight_on_rough_ground(push, factor):
    """Two feet of coefficient 0.3 under a weight of 1 hold a push of 0.3 and no more."""
    C = np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 1.0, 0.0], 6 * [0.0]])
    C[2, 3] = C[2, 5] = 1.0
    on_feet = np.array([[0, 2, 3], [1, 4, 5]])
    feet = ProductSet(cones=FrictionCones(on_feet, np.zeros(2), np.full(2, 0.3)))
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
    foot = ProductSet(cones=FrictionCones(np.array([[0, 1]]), np.zeros(1), np.ones(1)))
    x, _ = least_norm(C, np.array([1.0]), foot)
    # nothing asks for the normal force, which comes at no cost to the balance
    assert x[1] == pytest.approx(1.0)
    assert x[0] >= 1.0 - 1e-9
