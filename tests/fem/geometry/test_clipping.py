"""Intersections of intervals and polygons."""

import numpy as np
import pytest

from fenics_tfeti.fem.geometry.clipping import clip_intervals, clip_polygons, fan_triangles

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def area(subject, clipper):
    polygon, _, areas = fan_triangles(*clip_polygons(subject[None], clipper[None]))
    assert (polygon == 0).all()
    return areas.sum()


def test_intervals_of_either_order():
    ends = clip_intervals(np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[0.5, 2.0], [2.0, 0.5]]))
    assert np.array_equal(ends, [[0.5, 1.0], [0.5, 1.0]])
    apart = clip_intervals(np.array([[0.0, 1.0]]), np.array([[2.0, 3.0]]))
    assert apart[0, 1] == apart[0, 0]


@pytest.mark.parametrize(
    ("shift", "expected"),
    [((0.5, 0.5), 0.25), ((0.0, 0.0), 1.0), ((1.0, 0.0), 0.0), ((3.0, 0.0), 0.0), ((0.2, 0), 0.8)],
)
def test_shifted_squares(shift, expected):
    assert np.isclose(area(SQUARE + shift, SQUARE), expected, rtol=0.0, atol=1e-15)


def test_polygon_inside_the_other():
    inner = 0.25 + 0.5 * SQUARE
    assert np.isclose(area(inner, SQUARE), 0.25)
    assert np.isclose(area(SQUARE, inner), 0.25)


def test_octagon_of_two_squares():
    turn = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
    corners, count = clip_polygons(((SQUARE - 0.5) @ turn.T)[None], (SQUARE - 0.5)[None])
    assert count[0] == 8
    assert np.isclose(fan_triangles(corners, count)[2].sum(), 2.0 * (np.sqrt(2.0) - 1.0))


def test_random_triangles_against_their_exchange():
    random = np.random.default_rng(0)
    a, b = random.random((2, 2000, 3, 2))

    def anticlockwise(x):
        one, other = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
        turned = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] < 0.0
        x[turned] = x[turned, ::-1]
        return x

    def areas(one, other):
        polygon, _, size = fan_triangles(*clip_polygons(one, other))
        return np.bincount(polygon, size, len(one))

    a, b = anticlockwise(a), anticlockwise(b)
    assert np.allclose(areas(a, b), areas(b, a), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("tilt", [1e-6, 1e-10, 1e-13, 0.0])
def test_nearly_parallel_edges(tilt):
    """The cut of an edge that is nearly the clipping edge is on both."""
    turned = SQUARE + [[0.0, tilt], [0.0, -tilt], [0.0, 0.0], [0.0, 0.0]]
    corners, count = clip_polygons(turned[None], SQUARE[None])
    used = corners[0, : count[0]]
    assert (used > -1e-12).all() and (used < 1.0 + 1e-12).all()
    assert np.isclose(area(turned, SQUARE), 1.0 - 0.25 * tilt, rtol=0.0, atol=1e-12)
