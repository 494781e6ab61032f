"""The weight of the surface measure: what users may give, and the areas it makes."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from matching import match_contacts
from scenes import MASTER, SLAVE
from strips import matched, strips

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Plane, RigidObstacle
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, as_ufl_weight

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]


def thickness(space, x):
    """Return 1 + x, in the ways in which a user may have it."""
    function = fem.Function(scenes.scalar_space(space.mesh), name="the thickness")
    function.interpolate(lambda x: 1.0 + x[0])
    return {"expression": 1.0 + x[0], "function": function}


@pytest.mark.parametrize("number", [3, 3.0, np.float64(3.0), np.int64(3)])
def test_numbers_are_constants(number):
    """So that one compiled form does for all of them."""
    V, _ = strips()
    weight = as_ufl_weight(V.mesh, number)
    assert isinstance(weight, fem.Constant) and float(weight.value) == 3.0


@pytest.mark.parametrize("kind", ["expression", "function"])
@pytest.mark.parametrize("obstacle", [False, True])
def test_areas_are_integrals_of_the_weight(kind, obstacle):
    """The integrals of 1 + x times the shape functions on four facets of 1/4."""
    V, tags = strips()
    weight = thickness(V, ufl.SpatialCoordinate(V.mesh))[kind]
    ground = RigidObstacle(tags, SLAVE, Plane((0, 0), (0, 1)))
    pair = ContactPair(tags, SLAVE, MASTER)
    conditions = matched(V, ground if obstacle else pair, weight)
    order = np.argsort(conditions.coordinates[:, 0])
    h, x = 0.25, np.linspace(0, 1, 5)
    exact = h * (1 + x) * np.where((x == 0) | (x == 1), 0.5, 1.0)
    exact[0], exact[-1] = exact[0] + h**2 / 6, exact[-1] - h**2 / 6
    np.testing.assert_allclose(conditions.area[order], exact, rtol=1e-12)


@pytest.mark.parametrize("kind", ["expression", "function"])
def test_x_in_the_weight_is_where_the_nodes_are_and_functions_move_with_them(kind):
    V, _ = strips()
    weight = thickness(V, ufl.SpatialCoordinate(V.mesh))[kind]
    moved = fem.Function(V)
    moved.interpolate(lambda x: np.stack([0.5 + x[1], 0 * x[0]]))
    x, y, _ = V.tabulate_dof_coordinates().T
    expected = {"expression": 1.0 + x + 0.5 + y, "function": 1.0 + x}[kind]
    boundary = MeshBoundary.of(V, weight).deformed(moved)
    np.testing.assert_allclose(boundary.nodal_weight(), expected, rtol=1e-14)


@pytest.mark.parametrize("cell", CELLS)
def test_a_constant_weight_multiplies_areas(cell):
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 3)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER)
    plain = matched(scene.V, pair)
    weighted = matched(scene.V, pair, 3.0)
    np.testing.assert_allclose(weighted.area, 3.0 * plain.area, rtol=1e-12)
    np.testing.assert_array_equal(weighted.normal, plain.normal)
    np.testing.assert_array_equal(weighted.gap, plain.gap)


def test_weight_in_a_partial_contact():
    """The upper strip sticks out: of its last node with a partner one facet counts."""
    V, tags = strips()
    V.mesh.geometry.x[V.mesh.geometry.x[:, 1] > 1.05, 0] += 0.25
    r = ufl.SpatialCoordinate(V.mesh)[0]
    conditions = matched(V, ContactPair(tags, SLAVE, MASTER, partial=True), r)
    assert conditions.area.sum() == pytest.approx(0.5 * (1.0 - 0.25**2), rel=1e-12)


@pytest.mark.parametrize("obstacle", [False, True])
def test_a_changed_weight_is_noticed(obstacle):
    V, tags = strips()
    weight = fem.Constant(V.mesh, 1.0)
    ground = RigidObstacle(tags, SLAVE, Plane((0, 0), (0, 1)))
    contact = ground if obstacle else ContactPair(tags, SLAVE, MASTER)
    boundary = MeshBoundary.of(V, weight)
    first = match_contacts(boundary, [contact])[0]
    weight.value = 2.0
    second = match_contacts(boundary, [contact], [(contact, first)])[0]
    np.testing.assert_allclose(second.area, 2.0 * first.area, rtol=1e-14)
