"""Conditions of degree 2 at obstacles: means around the vertices."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mortar_blocks import LOWER, Blocks

from fenics_tfeti.fem.contact.mortar.conditions import SlaveFacets
from fenics_tfeti.fem.contact.mortar.one_sided import nodal_normals, one_sided_conditions
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def slave_facets(cell, **shape):
    scene = Blocks(cell, 3, 2, degree=2, **shape).scene()
    boundary = MeshBoundary.of(scene.V)
    surface = tagged_surface(boundary, scene.facet_tags, LOWER, "slave")
    points = boundary.coordinates[:, : scene.gdim]
    return surface, SlaveFacets.of(surface, points, None)


def conditions(surface, facets, chosen):
    return one_sided_conditions(MPI.COMM_SELF, facets, surface.nodes, chosen)


@pytest.mark.parametrize("cell", CELLS)
def test_means_of_linear_functions_are_their_values_at_the_vertices(cell):
    surface, facets = slave_facets(cell)
    nodes, terms = conditions(surface, facets, np.ones(len(facets.facets), dtype=bool))
    np.testing.assert_array_equal(nodes, np.sort(surface.nodes))
    values = 0.3 + facets.facets.points @ np.arange(1.0, 1.0 + surface.points.shape[1])
    mean = terms.means(values[np.searchsorted(facets.nodes, terms.nodes), None])[:, 0]
    np.testing.assert_allclose(mean, values[np.searchsorted(facets.nodes, nodes)], rtol=1e-13)
    area = np.zeros(nodes.size)
    area[np.searchsorted(nodes, surface.nodes)] = surface.area
    np.testing.assert_allclose(terms.scale, area, rtol=1e-13)


def test_facets_that_are_not_chosen_do_not_count():
    surface, facets = slave_facets("triangle")
    middle = facets.facets.points[facets.facets.corners].mean(axis=1)
    nodes, terms = conditions(surface, facets, middle[:, 0] < 0.6)
    x = facets.facets.points[np.searchsorted(facets.nodes, nodes), 0]
    assert sorted(np.round(x, 9)) == pytest.approx([0.0, 1 / 3, 2 / 3])
    assert terms.scale.sum() == pytest.approx(2 / 3)


@pytest.mark.parametrize("cell", CELLS)
def test_normals_at_all_nodes(cell):
    surface, facets = slave_facets(cell, slope=0.3)
    expected = np.tile(surface.normal[0], (len(facets.facets.points), 1))
    np.testing.assert_allclose(nodal_normals(facets), expected, atol=1e-13)
