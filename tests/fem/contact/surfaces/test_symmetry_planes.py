"""Normals at nodes in planes of symmetry."""

import numpy as np
from matching import match_contacts
from scenes import MASTER, SLAVE, at
from strips import bend, strips

from dolfinx import fem

from fenics_tfeti import ContactPair
from fenics_tfeti.fem.contact.surfaces.normals import normals_in_symmetry_planes
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.displacement import prescribed_components, prescribed_values
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti import Prescribed


def held(V, axis, x, component):
    """Prescribe a component on a plane."""
    dofs = fem.locate_dofs_geometrical(
        (V.sub(component), V.sub(component).collapse()[0]), at(axis, x)
    )
    zero = fem.Function(V.sub(component).collapse()[0])
    return prescribed_values(V, [fem.dirichletbc(zero, dofs, V.sub(component))])


def normals(V, tags, prescribed):
    surface = tagged_surface(MeshBoundary.of(V), tags, SLAVE, "slave")
    corrected = normals_in_symmetry_planes(
        surface, prescribed_components(surface.boundary.nodes, prescribed)[surface.local]
    )
    order = np.argsort(surface.coordinates[:, 0])
    return surface.normal[order], corrected[order]


def test_curved_surface_at_its_symmetry_plane():
    V, tags = strips((8, 2), (8, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0] ** 2, [0.0, 0.3, 0.0]))
    before, after = normals(V, tags, held(V, 0, 0.0, 0))
    assert abs(before[0, 0]) > 0.03
    np.testing.assert_allclose(after[0], [0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(before[1:], after[1:], atol=1e-15)


def test_inclined_plane_keeps_its_normal():
    V, tags = strips((8, 2), (8, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0], [0.0, 0.2, 0.0]))
    before, after = normals(V, tags, held(V, 0, 0.0, 0))
    np.testing.assert_allclose(before, after, atol=1e-15)


def test_prescribed_normal_displacement_keeps_the_normal():
    V, tags = strips((8, 2), (8, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0] ** 2, [0.0, 0.3, 0.0]))
    before, after = normals(V, tags, held(V, 0, 0.0, 1))
    np.testing.assert_allclose(before, after, atol=1e-15)


def test_no_prescribed_components():
    V, _ = strips()
    assert not prescribed_components(NodeMap(V), Prescribed()).any()


def test_conditions_are_anew_where_other_components_are_prescribed():
    V, tags = strips((8, 2), (5, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0] ** 2, [0.0, 0.3, 0.0]))
    boundary, pair = MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER)
    first = match_contacts(boundary, [pair])[0]
    assert match_contacts(boundary, [pair], [(pair, first)])[0] is first
    second = match_contacts(boundary, [pair], [(pair, first)], held(V, 0, 0.0, 0))[0]
    at_plane = np.isclose(first.coordinates[:, 0], 0.0)
    assert np.abs(first.normal[at_plane, 0]).min() > 0.03
    np.testing.assert_allclose(second.normal[at_plane, 0], 0.0, atol=1e-15)
