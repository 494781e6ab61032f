"""Normals, areas and sizes at the nodes of tagged surfaces."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from joined_bodies import block, halves, of_degree_two
from mesh_arrays import mesh_of
from scenes import MASTER, SLAVE
from strips import bend, matched, partners, ring, strips

import ufl
from dolfinx import fem
from dolfinx.mesh import meshtags

from fenics_tfeti import ContactPair, InputError, Mapped
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.topology import exterior_facets, vertex_nodes
from fenics_tfeti.io import displacement_space, tag_facets

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]


@pytest.mark.parametrize("given", [(0.0, -3.0), lambda x: -np.array([0 * x[0], 1 + x[0]])])
def test_normals_are_scaled_to_unit_length(given):
    V, tags = strips()
    conditions = matched(V, ContactPair(tags, SLAVE, MASTER, normal=given))
    np.testing.assert_allclose(conditions.normal, np.tile([0.0, -1.0], (5, 1)), atol=1e-15)


def test_analytic_normals_of_a_polygon():
    V, tags = ring()
    _, _, conditions = partners(V, ContactPair(tags, SLAVE, MASTER, normal=lambda x: x[:2]))
    np.testing.assert_allclose(conditions.normal, conditions.coordinates[:, :2], atol=1e-14)
    np.testing.assert_allclose(conditions.gap, 1.0, rtol=1e-13)


def test_averaged_normals_of_a_polygon():
    """Inside they are the radius, at the two ends the normal of the last facet."""
    V, tags = ring(n=8)
    _, _, conditions = partners(
        V, ContactPair(tags, SLAVE, MASTER, partners=Mapped(lambda x: 2 * x))
    )
    x, n = conditions.coordinates.T, conditions.normal.T
    sine = np.abs(n[0] * x[1] - n[1] * x[0])
    np.testing.assert_allclose(np.sort(sine)[-2:], np.sin(np.pi / 32), rtol=1e-12)
    np.testing.assert_allclose(np.sort(sine)[:-2], 0.0, atol=1e-15)


def surface_of(space, tags, tag, normal=None):
    return tagged_surface(MeshBoundary.of(space), tags, tag, "surface", user_normal=normal)


def test_area_is_that_projected_along_a_given_normal():
    V, tags = strips()
    surface = surface_of(V, tags, SLAVE, normal=(0.6, -0.8))
    assert surface.area.sum() == pytest.approx(0.8)


def test_size_is_that_of_the_smallest_facet_at_the_node():
    V, tags = strips()
    bend(V, lambda x: np.isclose(x[:, 0], 0.25), lambda x: x - [0.05, 0.0, 0.0])
    surface = surface_of(V, tags, SLAVE)
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(surface.size[order], [0.2, 0.2, 0.25, 0.25, 0.25])


def test_share_of_chosen_facets():
    V, tags = strips()
    boundary = MeshBoundary.of(V)
    surface = tagged_surface(boundary, tags, SLAVE, "surface")
    x = surface.corners[:, :, 0].mean(axis=1)
    area = surface.share_of_area(x < 0.5)
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(area[order], [0.125, 0.25, 0.125, 0.0, 0.0], atol=1e-15)


def test_values_of_nodes_are_those_of_facets():
    V, tags = strips()
    boundary = MeshBoundary.of(V)
    surface = tagged_surface(boundary, tags, SLAVE, "surface")
    corners = surface.at_corners(surface.points)
    np.testing.assert_array_equal(corners, boundary.coordinates[surface.vertices, :2])


def test_master_nodes_are_in_the_order_of_their_coordinates():
    V, tags = strips()
    nodes = surface_of(V, tags, MASTER).gathered_nodes()
    assert np.all(np.diff(nodes.points[:, 0]) > 0.0)


def test_normals_that_cancel_are_refused():
    """Both sides of a blade are one surface."""
    points = [(0.0, -5e-5), (1.0, 0.0), (0.0, 5e-5)]
    domain = mesh_of(MPI.COMM_SELF, "triangle", points, [(0, 1, 2)])
    tags = tag_facets(domain, {SLAVE: lambda x: x[0] > -1.0})
    with pytest.raises(InputError, match=r"around 1 nodes cancel, the first at \(1, 0\)"):
        surface_of(displacement_space(domain), tags, SLAVE)


@pytest.mark.parametrize(("cell", "degree"), list(zip(CELLS, (2, 1, 1, 2), strict=True)))
def test_normals_and_areas_are_those_of_forms(cell, degree):
    """On a wavy surface of straight or curved cells, without and with a weight."""
    mesh = of_degree_two(cell, halves, 2).mesh
    mesh = mesh if degree == 2 else block(cell, halves, n=2).mesh
    gdim, x = mesh.geometry.dim, mesh.geometry.x
    tags = tag_facets(mesh, {SLAVE: scenes.at(gdim - 1, 1.0)})
    x[:, gdim - 1] += 0.1 * x[:, gdim - 1] * np.sin(3.0 * x.sum(axis=1))
    V, linear = (displacement_space(mesh, k) for k in (degree, 1))
    weight = fem.Function(scenes.scalar_space(mesh))
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags, metadata={"quadrature_degree": 8})
    normal_part = fem.form(
        weight * ufl.inner(ufl.FacetNormal(mesh), ufl.TestFunction(linear)) * ds(SLAVE)
    )
    parts = []
    for of_place in (lambda x: 1.0 + 0.0 * x[0], lambda x: 1.0 + x[0] ** 2):
        weight.interpolate(of_place)
        parts.append(fem.assemble_vector(normal_part).array.reshape(-1, gdim).copy())
    plain, weighted = parts
    boundary = MeshBoundary.of(V, weight)
    surface = tagged_surface(boundary, tags, SLAVE, "surface")
    of_linear = np.zeros(boundary.nodes.size, dtype=np.int64)
    of_linear[vertex_nodes(V)] = vertex_nodes(linear)
    rows = of_linear[surface.local]
    length = np.linalg.norm(plain[rows], axis=1)
    np.testing.assert_allclose(surface.area, length, rtol=1e-13)
    np.testing.assert_allclose(surface.normal, plain[rows] / length[:, None], atol=2e-15)
    values = boundary.nodal_weight()
    every = np.ones(len(surface.facet_nodes), dtype=bool)
    expected = np.sum(weighted[rows] * surface.normal, axis=1)
    np.testing.assert_allclose(surface.share_of_area(every, values), expected, rtol=1e-13)


@pytest.mark.parametrize("cell", CELLS)
def test_normals_of_stretched_facets(cell):
    """Of facets in a plane, however long and thin, no normals cancel."""
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 2)
    scene.mesh.geometry.x[:, 0] *= 1e6
    surface = surface_of(scene.V, scene.facet_tags, SLAVE)
    up = np.eye(scene.mesh.geometry.dim)[-1]
    np.testing.assert_allclose(surface.normal, np.tile(-up, (surface.nodes.size, 1)), atol=1e-15)
    assert surface.area.sum() == pytest.approx(1e6)


def test_facets_inside_a_body_are_refused():
    V, _ = strips()
    domain = V.mesh
    domain.topology.create_connectivity(1, 2)
    inner = np.flatnonzero(~exterior_facets(domain)).astype(np.int32)
    tags = meshtags(domain, 1, inner, np.full(inner.size, SLAVE, dtype=np.int32))
    with pytest.raises(InputError, match=f"{inner.size} facets .* are inside a body"):
        surface_of(V, tags, SLAVE)


def ground(degree=1, weight=None):
    scene = scenes.pressed_block(MPI.COMM_SELF, "quadrilateral", 2)
    boundary = MeshBoundary.of(displacement_space(scene.mesh, degree), weight)
    return boundary, tagged_surface(boundary, scene.facet_tags, scenes.GROUND, "slave")


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("weight", [None, 3.0])
def test_areas_are_those_of_the_vertices_times_the_weight(weight, degree):
    boundary, surface = ground(degree, weight)
    assert (boundary.nodal_weight() is None) == (weight is None)
    areas = surface.areas(np.ones(2, dtype=bool))
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(areas[order], (weight or 1.0) * np.array([0.25, 0.5, 0.25]))


def test_nodes_of_covered_facets_have_their_area_there():
    _, surface = ground()
    middle = surface.corners[..., 0].mean(axis=1)
    areas = surface.areas(middle < 0.5)
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(areas[order], [0.25, 0.25, 0.25])
