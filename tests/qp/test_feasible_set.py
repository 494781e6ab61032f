"""Projection, boundary and split gradient, by their definitions, on feasible sets by hand."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from qp_problems import random_discs, random_intervals

from fenics_tfeti.qp import Bounds, Discs, ProductSet, Space

pytestmark = pytest.mark.once

INF = np.inf
BOUNDS = Bounds.from_vector(np.array([-INF, 0.0, 1.0, -2.0]))
# a line, a half-line downwards, an interval and a single value
INTERVALS = Bounds.from_vector(np.array([-INF, -INF, 1.0, 2.0]), np.array([INF, 0.0, 3.0, 2.0]))
# components 0 and 2 in a disc of radius 5 around (1, 1), 3 and 1 in the unit disc
DISCS = Discs(np.array([[0, 2], [3, 1]]), np.array([[1.0, 1.0], [0.0, 0.0]]), np.array([5.0, 1.0]))


def test_bounds_from_a_vector_take_the_finite_ones():
    assert BOUNDS.indices.tolist() == INTERVALS.indices.tolist() == [1, 2, 3]
    assert BOUNDS.lower.tolist() == [0.0, 1.0, -2.0]
    assert INTERVALS.upper.tolist() == [0.0, 3.0, 2.0]


@pytest.mark.parametrize(("factor", "x", "nearest", "active"), [
    (BOUNDS, (-9.0, -9.0, 3.0, -2.0), [-9.0, 0.0, 3.0, -2.0], [1, 3]),
    (BOUNDS, (0.0, -1.0, 1.0 + 1e-15, -2.0), [0.0, 0.0, 1.0 + 1e-15, -2.0], [1, 3]),
    (INTERVALS, (9.0, 9.0, 9.0, 9.0), [9.0, 0.0, 3.0, 2.0], [1, 2, 3]),
    (INTERVALS, (0.0, 1.0, 3.0 - 1e-15, 5.0), [0.0, 0.0, 3.0 - 1e-15, 2.0], [1, 3]),
    (DISCS, (7.0, 0.0, 9.0, 0.5), [4.0, 0.0, 5.0, 0.5], [0, 2]),
])  # fmt: skip
def test_projection_is_the_nearest_point_and_active_bounds_hold_exactly(factor, x, nearest, active):
    found = factor.project(np.array(x))
    np.testing.assert_allclose(found, nearest, rtol=1e-15 if factor is DISCS else 0.0)
    assert factor.on_boundary(found).tolist() == active


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("far", [0.0, 1e6])
@hypothesis.given(seed=st.integers(0, 10**6))
def test_what_is_projected_on_a_circle_is_on_it(scale, far, seed):
    rng = np.random.default_rng(seed)
    centre = scale * (far + rng.standard_normal((1, 2)))
    disc = Discs(np.array([[0, 1]]), centre, np.array([scale]))
    x = centre[0] + scale * (1.0 + rng.random()) * np.array([0.8, -0.6])
    assert disc.on_circle(disc.project(x)).all()
    x = centre[0] + scale * (1.0 - 1e-6) * np.array([0.8, -0.6])
    assert not disc.on_circle(x).any()


@pytest.mark.parametrize(("factor", "x", "direction", "length"), [
    (BOUNDS, (0.0, 2.0, 3.0, 1.0), (1.0, 0.0, 0.0, 0.0), INF),  # no bound
    (BOUNDS, (0.0, 2.0, 3.0, 1.0), (0.0, -1.0, -1.0, -1.0), INF),  # away from all bounds
    (BOUNDS, (0.0, 2.0, 3.0, 1.0), (5.0, 1.0, 1.0, 2.0), 1.5),  # to the bound of the last one
    (BOUNDS, (0.0, 2.0, 3.0, 1.0), (0.0, 4.0, 1.0, 0.0), 0.5),
    (INTERVALS, (0.0, -4.0, 2.0, 2.0), (1.0, 1.0, 0.0, 0.0), INF),  # downwards
    (INTERVALS, (0.0, -4.0, 2.0, 2.0), (0.0, -1.0, -0.1, 0.0), 4.0),  # to the upper bound of 1
    (INTERVALS, (0.0, -4.0, 2.0, 2.0), (0.0, -1.0, -1.0, 0.0), 1.0),  # to that of 2
    (INTERVALS, (0.0, -4.0, 2.0, 2.0), (0.0, 0.0, 2.0, 0.0), 0.5),  # to its lower one
    (INTERVALS, (0.0, -4.0, 2.0, 2.0), (0.0, 1.0, 0.0, 1.0), 0.0),  # nowhere
    (DISCS, (4.0, 0.0, 1.0, -1.0), (0.0, 0.0, 0.0, 0.0), INF),
    (DISCS, (4.0, 0.0, 1.0, -1.0), (-1.0, 0.0, 0.0, 0.0), 2.0),  # from (4, 1) to (6, 1)
    (DISCS, (4.0, 0.0, 1.0, -1.0), (1.0, 0.0, 0.0, 0.0), 8.0),  # to (-4, 1)
    (DISCS, (4.0, 0.0, 1.0, -1.0), (0.0, 0.0, -2.0, 0.0), 2.0),  # to (4, 5)
    (DISCS, (4.0, 0.0, 1.0, -1.0), (0.0, 0.0, 0.0, 1.0), 0.0),  # out of the unit disc
    (DISCS, (4.0, 0.0, 1.0, -1.0), (0.0, 0.0, 0.0, -1.0), 2.0),  # through it
    (DISCS, (4.0, 0.0, 1.0, -1.0), (0.0, 1.0, 0.0, 0.0), 0.0),  # along its tangent
])  # fmt: skip
def test_longest_step(factor, x, direction, length):
    found = factor.longest_step(np.array(x), np.array(direction))
    assert found == pytest.approx(length, rel=1e-15)


@hypothesis.given(seed=st.integers(0, 10**6), size=st.sampled_from([1e-6, 1.0]))
def test_longest_step_ends_on_the_circle(seed, size):
    rng, problem = np.random.default_rng(seed), random_discs(seed, size=size)
    x, p = problem.nearest(rng.standard_normal(24)), rng.standard_normal(24)
    p[problem.discs.indices[0]] = 0.0  # radius 0
    step = problem.discs.longest_step(x, p)
    assert np.isfinite(step)
    inside, outside = x - (1.0 - 1e-9) * step * p, x - (step + 1e-9 * size) * p
    at, centre, radius = problem.discs.indices, problem.discs.centre, problem.discs.radius
    assert np.all(np.hypot(*(inside[at] - centre).T) <= radius * (1.0 + 1e-12))
    assert np.any(np.hypot(*(outside[at] - centre).T) > radius)


def test_split_of_the_gradient():
    """Component 1 is active and wants to leave, 2 is active and stays, 3 is near its bound."""
    x, g = np.array([7.0, 0.0, 1.0, -1.5]), np.array([3.0, -4.0, 5.0, 6.0])
    Qx, Ap = np.array([1.0, 2.0, 0.0, 0.0]), np.array([1.0, 1.0, 1.0, 1.0])
    split = ProductSet(BOUNDS).split(x, g, 0.25, Space(), Qx, Ap)
    assert split.free.tolist() == [3.0, 0.0, 0.0, 6.0]
    assert split.boundary.tolist() == [0.0, -4.0, 0.0, 0.0]
    assert split.boundary2 == 16.0
    assert split.reduced_free == 3.0 * 3.0 + (0.5 / 0.25) * 6.0
    assert split.constraint2 == 5.0
    assert split.conjugation == 9.0
    assert split.gradient_norm == pytest.approx(np.sqrt(61.0), rel=1e-15)
    assert split.constraint_norm == pytest.approx(np.sqrt(5.0), rel=1e-15)


def test_split_of_the_gradient_between_bounds():
    """Component 1 leaves its upper bound, 2 is near both, 3 has nowhere to go."""
    x, g = np.array([7.0, 0.0, 1.5, 2.0]), np.array([3.0, 4.0, -8.0, 6.0])
    split = ProductSet(INTERVALS).split(x, g, 0.25, Space())
    assert split.free.tolist() == [3.0, 0.0, -8.0, 0.0]
    assert split.boundary.tolist() == [0.0, 4.0, 0.0, 0.0]
    assert not ProductSet(INTERVALS).split(x, -g, 0.25, Space()).boundary.any()
    assert split.boundary2 == 16.0
    assert split.reduced_free == 9.0 + (1.5 / 0.25) * 8.0


def test_split_of_the_gradient_on_discs():
    """The first disc is inside, its step is not; the second on the boundary, along the tangent."""
    feasible = ProductSet(discs=DISCS)
    x, g = np.array([5.0, 0.0, 1.0, 1.0]), np.array([-4.0, 3.0, 0.0, 0.0])
    split = feasible.split(x, g, 1.0, Space(), Ap=np.ones(4))
    assert split.free.tolist() == [-4.0, 0.0, 0.0, 0.0]
    tangential = np.array([3.0, 1.0]) / np.sqrt(10.0) - [0.0, 1.0]
    assert split.reduced_free == pytest.approx(4.0)  # (9, 1) is cut to (6, 1): phi~ = -1
    assert split.boundary2 == pytest.approx(tangential @ tangential, rel=1e-15)
    assert split.gradient_norm == pytest.approx(np.sqrt(16.0 + tangential @ tangential), rel=1e-15)
    assert split.conjugation == -4.0


@hypothesis.given(
    seed=st.integers(0, 10**6), step_length=st.sampled_from([1e-3, 1.0]), discs=st.booleans()
)
def test_reduced_gradient_is_the_projected_step(seed, step_length, discs):
    rng = np.random.default_rng(seed)
    problem = random_discs(seed) if discs else random_intervals(seed, 24)
    x, g = problem.nearest(rng.standard_normal(24)), rng.standard_normal(24)
    feasible = ProductSet(problem.bounds, problem.discs)
    expected = (x - problem.nearest(x - step_length * g)) / step_length
    reduced = feasible.reduced_gradient(x, g, step_length)
    np.testing.assert_allclose(reduced, expected, atol=1e-14 / step_length)


@pytest.mark.parametrize("gamma", [1e-12, 1.0, 1e12])
def test_reduced_gradient_vanishes_without_rounding_of_the_point(gamma):
    """An outward normal descent: rounding is relative to g, though x is much larger."""
    disc = Discs(np.array([[0, 1]]), np.array([[1e6, -1e6]]), np.array([3e5]))
    x = disc.project(np.array([4e6, 3e6]))
    normal = (x - disc.centre[0]) / 3e5
    reduced = disc.reduced_gradient(x, -gamma * normal, 1.0)
    assert np.linalg.norm(reduced) <= 1e-14 * gamma


def test_split_counts_owned_components_only():
    x, g = np.array([7.0, 0.0, 1.0, -1.5]), np.array([3.0, -4.0, 5.0, 6.0])
    split = ProductSet(BOUNDS).split(x, g, 0.25, Space(owned=2))
    assert split.free.tolist() == [3.0, 0.0, 0.0, 6.0]
    assert (split.gradient2, split.boundary2, split.reduced_free) == (25.0, 16.0, 9.0)
    assert (split.constraint2, split.conjugation) == (0.0, 0.0)
    unit = Discs(np.array([[0, 1], [2, 3]]), np.zeros((2, 2)), np.ones(2))
    x, g = np.array([0.0, 1.0, 0.0, 1.0]), np.array([0.0, 5.0, 0.0, 7.0])
    split = ProductSet(discs=unit).split(x, g, 0.25, Space(owned=2))
    # from (0, 1) by 5/4 to (0, -1/4): inside, so that the reduced gradient is g
    assert (split.gradient2, split.boundary2, split.reduced_free) == (25.0, 25.0, 0.0)


@hypothesis.given(seed=st.integers(0, 10**6), discs=st.booleans())
def test_derivative_of_the_projection_is_that_of_differences(seed, discs):
    rng = np.random.default_rng(seed)
    problem = random_discs(seed) if discs else random_intervals(seed, 24)
    feasible = ProductSet(problem.bounds, problem.discs)
    x, columns, step = rng.standard_normal(24), rng.standard_normal((24, 3)), 1e-7
    found = feasible.derivative(x) @ columns
    expected = np.column_stack(
        [
            (problem.nearest(x + step * p) - problem.nearest(x - step * p)) / (2 * step)
            for p in columns.T
        ]
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


@hypothesis.given(seed=st.integers(0, 10**6), factor=st.sampled_from([1e-3, 0.5, 7.0]))
def test_scaled_set_is_that_of_scaled_points(seed, factor):
    x, problem = np.random.default_rng(seed).standard_normal(24), random_discs(seed)
    scaled = ProductSet(problem.bounds, problem.discs).scaled(factor)
    np.testing.assert_allclose(
        scaled.project(factor * x), factor * problem.nearest(x), atol=1e-15 * factor
    )
