"""Deformed surfaces: orientation, normals, interpolation."""

import numpy as np
import pytest
from moved_blocks import CELLS, blocks, lifted, turned
from scenes import SLAVE, dimension

from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.normals import facet_normals

every_cell = pytest.mark.parametrize("cell", CELLS)


def surface(cell, motion=None, n=3):
    scene = blocks(cell, n)
    boundary = MeshBoundary.of(scene.V)
    found = tagged_surface(boundary, scene.facet_tags, SLAVE, "surface")
    return found.on(boundary.deformed(scene.displacement(upper=motion))).gathered()


@every_cell
def test_facets_point_out_of_the_body(cell):
    found = surface(cell)
    faceted = FacetedSurface.of(found.facets)
    assert len(found.nodes) == 4 ** (dimension(cell) - 1)
    below = found.points - 0.1 * np.eye(dimension(cell))[-1]
    np.testing.assert_allclose(faceted.distance(below).signed, 0.1)


@every_cell
def test_normals_turn_with_the_body(cell):
    Q, motion = turned(0.7, dimension(cell), shift=0.3)
    normals = surface(cell, motion).normal
    np.testing.assert_allclose(normals, np.tile(-Q[:, -1], (len(normals), 1)), atol=1e-14)


@every_cell
def test_points_are_those_of_the_undeformed_surface_displaced(cell):
    moved = surface(cell, lifted(lambda *x: 0.1 * x[0]))
    expected = surface(cell).points
    expected[:, -1] += 0.1 * expected[:, 0]
    np.testing.assert_allclose(moved.points, expected, atol=1e-15)


@every_cell
def test_linear_values_are_interpolated_exactly(cell):
    found = surface(cell)
    x = found.points[:-1] + 0.4 * np.diff(found.points, axis=0)
    linear = found.points @ np.arange(1.0, 1.0 + x.shape[1])
    expected = x @ np.arange(1.0, 1.0 + x.shape[1])
    np.testing.assert_allclose(found.interpolate(linear[:, None], x)[:, 0], expected, rtol=1e-13)


def test_quadrilateral_is_four_triangles_around_its_centre():
    found = surface("hexahedron", n=1)
    assert found.facets.nodes.shape == (1, 4)
    centre = found.points.mean(axis=0)
    assert np.abs(FacetedSurface.of(found.facets).distance(centre[None]).signed) < 1e-15


def test_area_of_the_facets():
    found = surface("tetrahedron")
    normals = facet_normals(found.points[found.facets.nodes])
    np.testing.assert_allclose(normals.sum(axis=0), [0.0, 0.0, -1.0], atol=1e-14)
