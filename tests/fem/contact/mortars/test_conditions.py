"""Mortar conditions of dolfinx surfaces."""

import numpy as np
import pytest
from matching import match_contacts
from mortar_blocks import LOWER, UPPER, Blocks

import ufl

from fenics_tfeti import ContactPair, Mortar, Nearest
from fenics_tfeti.fem.contact.conditions.mortars import one_sided_conditions
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.geometry.facets import Planes

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


def scene(blocks):
    made = blocks.scene()
    return made.V, made.facet_tags


@pytest.mark.parametrize("cell", CELLS)
def test_facets_are_oriented_outwards_and_carry_their_normals(cell):
    V, tags = scene(Blocks(cell, 3, 4, slope=0.3))
    boundary = MeshBoundary.of(V, ufl.SpatialCoordinate(V.mesh)[0])
    for tag, sign in ((LOWER, 1.0), (UPPER, -1.0)):
        surface = tagged_surface(boundary, tags, tag, "slave")
        d = surface.normal.shape[1]
        points = boundary.coordinates[:, :d]
        facets = surface.oriented_part()
        expected = sign * np.array([-0.3, *[0.0] * (d - 2), 1.0]) / np.sqrt(1.09)
        normal = Planes.of(facets.facets.coordinates()).normal
        np.testing.assert_allclose(normal, np.tile(expected, (len(normal), 1)), atol=1e-12)
        normals = np.tile(expected, (len(facets.nodes), 1))
        np.testing.assert_allclose(facets.normal, normals, atol=1e-12)
        corners = facets.facets.coordinates()
        np.testing.assert_allclose(facets.corner_weight, corners[..., 0], atol=1e-15)
        numbers = V.dofmap.index_map.local_to_global(np.arange(len(points), dtype=np.int32))
        place = points[np.argsort(numbers)]
        np.testing.assert_array_equal(facets.points, place[facets.nodes])


@pytest.mark.parametrize("cell", CELLS)
def test_terms_of_a_condition(cell):
    V, tags = scene(Blocks(cell, 3, 4, width=0.63))
    conditions = match_contacts(MeshBoundary.of(V), [ContactPair(tags, LOWER, UPPER)])[0]
    terms = conditions.terms
    np.testing.assert_array_equal(terms.nodes[terms.offsets[:-1]], conditions.slave)
    assert (conditions.area > 0.0).all()
    np.testing.assert_allclose(terms.scale, conditions.area)
    assert conditions.area.sum() == pytest.approx(0.63 ** (V.mesh.geometry.dim - 1))
    # constants and linear functions
    sums = np.zeros((conditions.slave.size, 4))
    x = V.tabulate_dof_coordinates()
    values = np.column_stack([np.ones(len(x)), x])
    np.add.at(sums, terms.row, terms.weights[:, None] * values[terms.nodes])
    assert np.abs(sums / conditions.area[:, None]).max() < 1e-12
    # distinct nodes, as the solver wants them
    pairs = terms.row * (terms.nodes.max() + 1) + terms.nodes
    assert np.unique(pairs).size == pairs.size


@pytest.mark.parametrize("height", [0.0, 0.2])
@pytest.mark.parametrize("cell", CELLS)
def test_flat_matching_surfaces_have_two_terms_a_condition(cell, height):
    """The conditions are those of pairs of nodes."""
    beams = Blocks(cell, 4, 4).scene()
    beams.mesh.geometry.x[beams.nodes(2), beams.gdim - 1] += height
    boundary, tags = MeshBoundary.of(beams.V), beams.facet_tags
    mortar, pairs = (
        match_contacts(boundary, [ContactPair(tags, UPPER, LOWER, partners=kind)])[0]
        for kind in (Mortar(), Nearest())
    )
    np.testing.assert_array_equal(np.diff(mortar.terms.offsets), 2)
    for name in ("slave", "master"):
        np.testing.assert_array_equal(getattr(mortar, name), getattr(pairs, name))
    np.testing.assert_allclose(mortar.terms.weights[::2], pairs.area, rtol=1e-12)
    np.testing.assert_allclose(mortar.terms.weights[1::2], -pairs.area, rtol=1e-12)
    for name in ("normal", "gap", "area"):
        np.testing.assert_allclose(
            getattr(mortar, name), getattr(pairs, name), rtol=1e-12, atol=1e-15
        )


def normals(x):
    return np.array([x[0], np.ones_like(x[0])]) / np.hypot(x[0], 1.0)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("covered", [0.1, 0.02])
def test_conditions_at_the_rim(covered, degree):
    """Of the facet from 0.5 to 0.75 m the master covers a part: that of node 0.75 ends there."""
    V, tags = scene(Blocks("triangle", 4, 3, width=0.5 + covered, degree=degree))
    pair = ContactPair(tags, LOWER, UPPER, normal=normals)
    conditions = match_contacts(MeshBoundary.of(V), [pair])[0]
    order = np.argsort(conditions.coordinates[:, 0])
    half, n = 0.5 * covered, normals(np.array([[0.0, 0.25, 0.5, 0.75]])).T
    at_rim = n[2] + (n[3] - n[2]) * covered / 0.25
    if covered == 0.1:
        areas, expected = [0.125, 0.25, 0.125 + half, half], [*n[:3], at_rim]
    else:
        # a support below 0.1: the node's function belongs to its neighbour
        areas, expected = [0.125, 0.25, 0.125 + covered], [*n[:2], (0.125 + half) * n[2]]
        expected[2] = expected[2] + half * at_rim
    np.testing.assert_allclose(conditions.area[order], areas, rtol=1e-12)
    expected = np.array(expected) / np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(conditions.normal[order], expected, atol=1e-14)
    # the place on the slave that each condition speaks of
    places = [0.0, 0.25, 0.5, 0.5 + covered]
    if covered < 0.1:
        places[2:] = [0.5 + half * covered / (0.125 + covered)]
    terms, x = conditions.terms, V.tabulate_dof_coordinates()[:, 0]
    weights = np.where(terms.on_slave, terms.weights, 0.0)
    found = np.bincount(terms.row, weights * x[terms.nodes]) / terms.scale
    np.testing.assert_allclose(found[order], places, atol=1e-13)


@pytest.mark.parametrize("cell", CELLS)
def test_pressures_of_barely_covered_nodes_are_means(cell):
    """The resultant and a uniform pressure stay; a node covered by less than 0.4 adds no value."""
    V, tags = scene(Blocks(cell, 4, 3, width=0.53))
    conditions = match_contacts(MeshBoundary.of(V), [ContactPair(tags, LOWER, UPPER)])[0]
    np.testing.assert_allclose(conditions.mean_traction(conditions.area), 1.0, rtol=1e-13)
    force = np.random.default_rng(0).random((conditions.area.size, 2))
    pressure = conditions.mean_traction(force)
    np.testing.assert_allclose(conditions.area @ pressure, force.sum(axis=0), rtol=1e-12)
    few = conditions.coverage < 0.4
    assert few.any() and not few.all()
    own = force / conditions.area[:, None]
    assert own[few].max() > 3.0 * pressure.max()
    inner = (conditions.coordinates[:, : V.mesh.geometry.dim - 1] < 0.2).all(axis=1)
    assert inner.any()
    np.testing.assert_allclose(pressure[inner], own[inner], rtol=1e-13)


def test_linear_weight_of_the_measure():
    V, tags = scene(Blocks("quadrilateral", 3, 4))
    radius = 1.0 + ufl.SpatialCoordinate(V.mesh)[0]
    pair = ContactPair(tags, LOWER, UPPER)
    conditions = match_contacts(MeshBoundary.of(V, 2.0 * radius), [pair])[0]
    assert conditions.area.sum() == pytest.approx(3.0)
    assert conditions.summary["covered_area"] == pytest.approx(1.0)


# -- obstacles, degree 2 ----------------------------------------------------------------------


def slave_facets(cell, **shape):
    V, tags = scene(Blocks(cell, 3, 2, degree=2, **shape))
    surface = tagged_surface(MeshBoundary.of(V), tags, LOWER, "slave")
    return surface, surface.oriented_part()


@pytest.mark.parametrize("cell", CELLS)
def test_means_of_linear_functions_are_their_values_at_the_vertices(cell):
    surface, facets = slave_facets(cell)
    terms = one_sided_conditions(surface, facets, np.ones(len(facets.facets), dtype=bool))
    nodes = terms.slave
    np.testing.assert_array_equal(nodes, np.sort(surface.nodes))
    values = 0.3 + facets.points @ np.arange(1.0, 1.0 + surface.points.shape[1])
    mean = terms.means(values[np.searchsorted(facets.nodes, terms.nodes), None])[:, 0]
    np.testing.assert_allclose(mean, values[np.searchsorted(facets.nodes, nodes)], rtol=1e-13)
    area = np.zeros(nodes.size)
    area[np.searchsorted(nodes, surface.nodes)] = surface.area
    np.testing.assert_allclose(terms.scale, area, rtol=1e-13)


def test_facets_that_are_not_chosen_do_not_count():
    surface, facets = slave_facets("triangle")
    middle = facets.points[facets.facets.corners].mean(axis=1)
    terms = one_sided_conditions(surface, facets, middle[:, 0] < 0.6)
    x = facets.points[np.searchsorted(facets.nodes, terms.slave), 0]
    assert sorted(np.round(x, 9)) == pytest.approx([0.0, 1 / 3, 2 / 3])
    assert terms.scale.sum() == pytest.approx(2 / 3)


@pytest.mark.parametrize("cell", CELLS)
def test_normals_at_all_nodes(cell):
    surface, facets = slave_facets(cell, slope=0.3)
    expected = np.tile(surface.normal[0], (len(facets.points), 1))
    np.testing.assert_allclose(facets.from_corners(facets.normal), expected, atol=1e-13)
