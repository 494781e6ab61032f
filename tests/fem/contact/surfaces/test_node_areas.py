"""Areas that belong to the nodes of a surface."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, pressed_block

from fenics_tfeti.fem.contact.surfaces.node_areas import node_areas
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.io import displacement_space


def ground(degree=1, weight=None):
    scene = pressed_block(MPI.COMM_SELF, "quadrilateral", 2)
    boundary = MeshBoundary.of(displacement_space(scene.mesh, degree), weight)
    return boundary, tagged_surface(boundary, scene.facet_tags, GROUND, "slave")


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("weight", [None, 3.0])
def test_areas_are_those_of_the_vertices_times_the_weight(weight, degree):
    boundary, surface = ground(degree, weight)
    assert (boundary.nodal_weight() is None) == (weight is None)
    areas = node_areas(surface, np.ones(2, dtype=bool), "joint")
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(areas[order], (weight or 1.0) * np.array([0.25, 0.5, 0.25]))


def test_nodes_of_covered_facets_have_their_area_there():
    _, surface = ground()
    middle = surface.corners[..., 0].mean(axis=1)
    areas = node_areas(surface, middle < 0.5, "joint")
    order = np.argsort(surface.points[:, 0])
    np.testing.assert_allclose(areas[order], [0.25, 0.25, 0.25])
