"""Conditions at obstacles are those of one process, also where facets around a node are shared."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, pressed_block, vector_space

from dolfinx import fem

from fenics_tfeti import RigidObstacle, Sphere
from fenics_tfeti.fem.contact.obstacle_conditions import deformed_gaps, match_obstacle
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD


def conditions(comm, cell, degree):
    """Return places, normals, gaps and areas, undeformed and deformed, in the order of places."""
    scene = pressed_block(comm, cell, 4)
    space, d = vector_space(scene.mesh, degree), scene.mesh.geometry.dim
    ball = Sphere((0.3,) * (d - 1) + (-2.0,), 1.9)
    contact = RigidObstacle(scene.facet_tags, GROUND, lambda x: ball(x[:d])[0])
    found = match_obstacle(MeshBoundary.of(space), "ground", contact, None)
    u = fem.Function(space)
    u.interpolate(lambda x: np.stack([0.05 * x[k] ** 2 - 0.01 for k in range(d)]))
    normal, gap, distance = deformed_gaps(MeshBoundary.of(space), contact, found, u)
    columns = (found.coordinates, found.normal, found.gap, found.area, normal, gap, distance)
    rows = concatenate_ranks(comm, np.column_stack(columns))
    return rows[np.lexsort(np.round(rows[:, :3], 9).T)]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_conditions_of_all_ranks(cell, degree):
    here, alone = (conditions(comm, cell, degree) for comm in (COMM, MPI.COMM_SELF))
    assert len(alone) == 5 ** (2 if "hedron" in cell else 1)
    np.testing.assert_allclose(here, alone, atol=1e-12)
