"""Signed distances to facets, and gaps along lines."""

from __future__ import annotations

import numpy as np
import pytest

from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.normals import facet_normals

HALF = np.array([0.5, 0.3, 0.2])


def halved(at: np.ndarray) -> np.ndarray:
    """Return the triangles of a grid of points."""
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def box(gdim: int, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return points and outward facets of a box of half sides HALF around 0, n facets a side."""
    points, facets = [], []
    for axis in range(gdim):
        for side in (-1.0, 1.0):
            across = [k for k in range(gdim) if k != axis]
            grid = np.meshgrid(*[np.linspace(-1, 1, n + 1)] * (gdim - 1), indexing="ij")
            face = np.full((grid[0].size, gdim), side)
            face[:, across] = np.column_stack([g.ravel() for g in grid])
            at = np.arange(len(face)).reshape(grid[0].shape)
            cells = np.column_stack([at[:-1], at[1:]]) if gdim == 2 else halved(at)
            inwards = facet_normals(face[cells])[:, axis] * side < 0.0
            cells[inwards] = cells[inwards][:, ::-1]
            facets.append(cells + sum(map(len, points)))
            points.append(face)
    merged, where = np.unique(np.round(np.concatenate(points), 9), axis=0, return_inverse=True)
    return merged * HALF[:gdim], where.ravel()[np.concatenate(facets)]


def box_distance(x):
    """Return the signed distance to the box."""
    over = np.abs(x) - HALF[: x.shape[1]]
    return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)


def somewhere(gdim: int, k: int = 500, size: float = 0.8) -> np.ndarray:
    return np.random.default_rng(3).uniform(-size, size, (k, gdim))


@pytest.fixture(scope="module", params=[2, 3])
def closed_box(request):
    return FacetedSurface(*box(request.param)), request.param


def test_distance_to_a_box(closed_box):
    """Also of points on it, and of more than are taken at once."""
    surface, gdim = closed_box
    x = np.concatenate([somewhere(gdim, k=5000), box(gdim)[0]])
    np.testing.assert_allclose(surface.distance(x).signed, box_distance(x), atol=1e-14)


def test_normal_is_the_gradient_of_the_distance(closed_box):
    surface, gdim = closed_box
    x = somewhere(gdim)
    steps = 1e-6 * np.eye(gdim)
    growth = [(box_distance(x + step) - box_distance(x - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(surface.distance(x).normal, np.transpose(growth), atol=1e-6)


def test_normals_on_faces_and_corners(closed_box):
    surface, gdim = closed_box
    on_face, corner = np.zeros(gdim), HALF[:gdim]
    on_face[-1] = -HALF[gdim - 1]
    normal = surface.distance(np.array([on_face, corner])).normal
    expected = [-np.eye(gdim)[-1], np.full(gdim, gdim**-0.5)]
    np.testing.assert_allclose(normal, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("across", "over", "angle", "gap"),
    [
        # from far above to the face ahead
        (None, 0.7, np.pi / 6, lambda over: over / np.sqrt(0.75)),
        # from inside back to the face that it came through
        (None, -0.01, 0.0, lambda over: over),
        # from inside out of the box: no face that faces the line is met
        (None, -0.1, np.pi, lambda over: 2.0 * over),
        # grazing: twice the distance
        (None, 0.01, np.pi / 2 - 0.1, lambda over: 2.0 * over),
        # just beside a corner: the plane before it
        (HALF[0] - 0.01, 0.1, 0.2, lambda over: over / np.cos(0.2)),
    ],
    ids=["ahead", "back", "away", "grazing", "corner"],
)
def test_gap_along_a_line(closed_box, across, over, angle, gap):
    """From a point over the upper face, downwards at an angle to the normal."""
    surface, gdim = closed_box
    x, direction = np.zeros((1, gdim)), np.zeros((1, gdim))
    x[0, 0], x[0, -1] = across or 0.0, HALF[gdim - 1] + over
    direction[0, 0], direction[0, -1] = np.sin(angle), -np.cos(angle)
    found, signed = surface.gap_along(x, direction)
    assert (found[0], signed[0]) == pytest.approx((gap(over), over))


def test_line_goes_back_through_another_face_than_the_closest(closed_box):
    surface, gdim = closed_box
    x = np.zeros((1, gdim))
    x[0, 0], x[0, -1] = HALF[0] - 0.03, HALF[gdim - 1] - 0.05
    gap, signed = surface.gap_along(x, -np.eye(gdim)[-1:])
    assert (gap[0], signed[0]) == pytest.approx((-0.05, -0.03))


def test_no_points(closed_box):
    surface, gdim = closed_box
    none = np.zeros((0, gdim))
    assert surface.distance(none).signed.shape == (0,)
    assert [part.shape for part in surface.gap_along(none, none)] == [(0,), (0,)]


def distance_to_triangle(corners, x):
    """Return the distance by the naive way: to the edges, and to the plane above the inside."""
    a, b, c = corners
    lengths = []
    for start, end in ((a, b), (b, c), (c, a)):
        step = end - start
        t = np.clip((x - start) @ step / (step @ step), 0.0, 1.0)
        lengths.append(np.linalg.norm(x - start - t[:, None] * step, axis=1))
    normal = np.cross(b - a, c - a)
    weights = np.linalg.solve(np.column_stack([b - a, c - a, normal]), (x - a).T)
    above = (weights[0] >= 0.0) & (weights[1] >= 0.0) & (weights[0] + weights[1] <= 1.0)
    lengths.append(np.where(above, np.abs(weights[2]) * np.linalg.norm(normal), np.inf))
    return np.min(lengths, axis=0)


@pytest.mark.parametrize("thin", [1.0, 1e-3])
def test_tree_finds_the_closest_of_all_facets(thin):
    """A rough surface of facets of very different sizes and shapes."""
    rng = np.random.default_rng(5)
    grid = np.cumsum(rng.uniform(0.01, 1.0, 15))
    X, Y = np.meshgrid(grid / grid[-1], thin * grid / grid[-1], indexing="ij")
    points = np.column_stack([X.ravel(), Y.ravel(), 0.1 * rng.random(X.size)])
    facets = halved(np.arange(X.size).reshape(X.shape))
    x = rng.random((200, 3)) * [1.0, thin, 0.2]
    facet, weights = FacetedSurface(points, facets).closest(x)
    closest = np.einsum("kc,kcd->kd", weights, points[facets[facet]])
    exact = np.min([distance_to_triangle(points[corners], x) for corners in facets], axis=0)
    np.testing.assert_allclose(np.linalg.norm(x - closest, axis=1), exact, atol=1e-13)


def test_inside_and_outside_at_a_sharp_edge():
    """The facet on the other side of the edge takes the point for one inside."""
    wedge = FacetedSurface(
        np.array([[-0.1, -1.0], [0.0, 0.0], [0.1, -1.0]]), np.array([[1, 0], [2, 1]])
    )
    x = np.array([[-0.5, 0.2], [0.5, 0.2], [0.0, -0.5]])
    signed = wedge.distance(x).signed
    depth = 0.05 / np.sqrt(1.01)
    np.testing.assert_allclose(signed, [np.hypot(0.5, 0.2)] * 2 + [-depth])


def floor(gdim: int) -> FacetedSurface:
    """Return an open surface at height 0 between 0 and 1, with facets of length 0.25."""
    x = np.linspace(0.0, 1.0, 5)
    if gdim == 2:
        return FacetedSurface(
            np.column_stack([x, 0 * x]), np.column_stack([np.arange(1, 5), np.arange(4)])
        )
    X, Y = (g.ravel() for g in np.meshgrid(x, x, indexing="ij"))
    return FacetedSurface(np.column_stack([X, Y, 0 * X]), halved(np.arange(25).reshape(5, 5)))


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize("height", [0.05, -0.05])
def test_border_is_continued_by_half_a_facet(gdim, height):
    x = np.full((1, gdim), 0.5)
    x[0, 0], x[0, -1] = 1.1, height
    gap, signed = floor(gdim).gap_along(x, -np.eye(gdim)[-1:])
    assert (gap[0], signed[0]) == pytest.approx((height, height))


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize("height", [0.05, -0.05])
def test_farther_beyond_the_border_is_outside(gdim, height):
    x = np.full((1, gdim), 0.5)
    x[0, 0], x[0, -1] = 1.5, height
    gap, signed = floor(gdim).gap_along(x, -np.eye(gdim)[-1:])
    distance = np.hypot(0.5, height)
    assert (gap[0], signed[0]) == pytest.approx((2.0 * distance, distance))


def test_line_through_a_common_corner_of_facets_meets_them():
    x = np.array([[0.25, 0.5, 0.1], [0.375, 0.5, 0.1]])
    gap = floor(3).gap_along(x, np.tile([0.0, 0.0, -1.0], (2, 1)))[0]
    np.testing.assert_allclose(gap, 0.1)


def test_facet_without_length_changes_nothing():
    points = np.array([[1.0, 0.0], [0.5, 0.0], [0.5, 0.0], [0.0, 0.0]])
    surface = FacetedSurface(points, np.array([[0, 1], [1, 2], [2, 3]]))
    x = np.array([[0.5, 0.1], [0.2, -0.1]])
    np.testing.assert_allclose(surface.distance(x).signed, [0.1, -0.1])


def test_facet_without_area_changes_nothing():
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
    surface = FacetedSurface(points, np.array([[0, 1, 2], [0, 3, 1]]))
    x = np.array([[0.2, 0.2, 0.1], [0.5, 0.1, -0.05]])
    gap, signed = surface.gap_along(x, np.tile([0.0, 0.0, -1.0], (2, 1)))
    np.testing.assert_allclose(signed, [0.1, -0.05])
    np.testing.assert_allclose(gap, [0.1, -0.05])
