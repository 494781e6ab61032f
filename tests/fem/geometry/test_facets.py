"""Planes of facets, shape functions and reference coordinates."""

import numpy as np
import pytest
from facet_grids import chain, grid

from fenics_tfeti.fem.geometry.facets import Planes, reference_coordinates, shape_functions
from fenics_tfeti.fem.geometry.vectors import highest, lowest

WARPED = np.array([[0.0, 0.0, 0.1], [2.0, 0.1, 0.0], [1.8, 1.0, 0.1], [-0.1, 1.2, 0.0]])


@pytest.mark.parametrize("corners", [3, 4])
def test_plane_of_a_flat_facet(corners):
    surface = grid((1, 1), high=(2.0, 1.0), height=lambda x, y: x, corners=corners)
    planes = Planes.of(surface.coordinates())
    assert np.allclose(planes.normal, [-np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    assert np.isclose(planes.area.sum(), 2.0 * np.sqrt(2.0))
    assert np.allclose(planes.diameter, 3.0)
    assert np.allclose(planes.axes @ planes.axes.transpose(0, 2, 1), np.eye(3))


def test_line_of_a_segment():
    surface = chain([0.0, 2.0], up=True)
    planes = Planes.of(surface.coordinates())
    assert np.allclose(planes.normal, [0.0, 1.0])
    assert planes.area == planes.diameter == 2.0
    frame = planes.project(np.array([0]), np.array([[[0.0, 3.0], [2.0, 4.0]]]))
    assert np.allclose(frame, [[[1.0, 3.0], [-1.0, 4.0]]])


def test_projection_keeps_lengths_and_shows_heights():
    planes = Planes.of(WARPED[None])
    frame = planes.project(np.zeros(1, dtype=int), WARPED[None])[0]
    assert np.isclose(np.linalg.norm(frame[1] - frame[0]), np.linalg.norm(WARPED[1] - WARPED[0]))
    # the diagonals are parallel to the plane
    assert np.isclose(frame[0, 2], frame[2, 2]) and np.isclose(frame[1, 2], frame[3, 2])


def test_lowest_and_highest_over_corners():
    x = np.random.default_rng(0).random((5, 4, 3))
    assert np.array_equal(lowest(x), x.min(axis=1))
    assert np.array_equal(highest(x), x.max(axis=1))


@pytest.mark.parametrize("v", [2, 3, 4])
def test_reference_coordinates_invert_the_map(v):
    corners = {2: np.array([[3.0], [1.0]]), 3: WARPED[:3, :2], 4: WARPED[:, :2]}[v]
    xi = np.random.default_rng(1).random((1, 6, corners.shape[1])) * (0.5 if v == 3 else 1.0)
    x = shape_functions(xi, v) @ corners
    assert np.allclose(reference_coordinates(corners[None], x), xi, atol=1e-14)
    assert np.allclose(shape_functions(xi, v).sum(axis=-1), 1.0)


def test_chosen_coordinates():
    surface = grid((2, 2))
    some = np.array([1, 5])
    assert np.array_equal(surface.coordinates(some), surface.coordinates()[some])
    assert len(surface) == 8
