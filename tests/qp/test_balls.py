"""Vectors within balls, by hand and by differences."""

import numpy as np
import pytest

from fenics_tfeti.qp import balls

pytestmark = pytest.mark.once

RADIUS = np.array([5.0, 2.0, 0.0])


def test_points_in_discs():
    y = np.array([[6.0, 8.0], [1.0, 1.0], [3.0, 0.0]])
    np.testing.assert_allclose(balls.project(y, RADIUS), [[3.0, 4.0], [1.0, 1.0], [0.0, 0.0]])
    assert balls.inside(y, RADIUS).tolist() == [False, True, False]
    on_circle = balls.on_boundary(y, RADIUS, np.array([False, True, True]))
    np.testing.assert_allclose(on_circle, [[6.0, 8.0], 2 * [np.sqrt(2.0)], [0.0, 0.0]])


def test_points_in_intervals():
    y = np.array([[-7.0], [0.0], [1.0]])
    assert balls.project(y, RADIUS).tolist() == [[-5.0], [0.0], [0.0]]
    assert balls.inside(y, RADIUS).tolist() == [False, True, False]
    assert balls.directions(y).tolist() == [[-1.0], [0.0], [1.0]]
    assert balls.on_boundary(y, RADIUS, np.ones(3, dtype=bool)).tolist() == [[-5.0], [0.0], [0.0]]

    y = np.array([[3.0, 4.0 - 1e-12], [2.0 - 1e-6, 0.0]])
    assert balls.inside(y, RADIUS[:2]).tolist() == [False, True]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0])
def test_misalignment_has_no_cancellation(angle):
    """|v| - v'l = |v| (1 - cos angle) = 2 |v| sin(angle / 2)^2."""
    v, direction = np.array([[7.0, 0.0]]), np.array([[np.cos(angle), np.sin(angle)]])
    expected = 14.0 * np.sin(0.5 * angle) ** 2
    np.testing.assert_allclose(balls.misalignment(v, direction), [expected], rtol=1e-6)


def test_curvature_is_that_of_differences():
    """Of -v'y for a y of length r that turns; none against y, and none at r = 0."""
    y, v = np.array([[3.0, 4.0]]), np.array([[2.0, 1.0]])
    tangent, step = balls.tangents(balls.directions(y)), 1e-3
    costs = [-np.sum(v * (np.cos(t) * y + 5.0 * np.sin(t) * tangent)) for t in (-step, 0, step)]
    second = (costs[0] - 2.0 * costs[1] + costs[2]) / (5.0 * step) ** 2
    found = balls.curvature(y, v, RADIUS[:1])
    np.testing.assert_allclose(found, [second], rtol=1e-6)
    assert balls.curvature(y, -v, RADIUS[:1]).tolist() == [0.0]
    assert balls.curvature(y, v, np.zeros(1)).tolist() == [0.0]
