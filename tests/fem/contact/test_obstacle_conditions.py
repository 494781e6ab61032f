"""Conditions at rigid obstacles, for displacements of degree 1 and 2."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, dimension, pressed_block

from dolfinx import fem

from fenics_tfeti import Plane, RigidObstacle, Sphere
from fenics_tfeti.fem.contact.conditions.deformed import deformed_contacts
from fenics_tfeti.fem.contact.conditions.obstacle import match_obstacles
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import displacement_space
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]
both_degrees = pytest.mark.parametrize("degree", [1, 2])
GAP = 0.25


def matched(cell, degree, obstacle, weight=None):
    scene = pressed_block(MPI.COMM_SELF, cell, 2)
    contact = RigidObstacle(scene.facet_tags, GROUND, obstacle)
    space = displacement_space(scene.mesh, degree)
    boundary = MeshBoundary.of(space, weight)
    (found,) = match_obstacles(boundary, [("ground", contact)], [None])
    return space, contact, found


def tilted(d):
    """Return a plane below the block that comes nearer to it along the first axis."""
    return Plane((0.0,) * (d - 1) + (-GAP,), (-0.1,) + (0.0,) * (d - 2) + (1.0,))


@both_degrees
@pytest.mark.parametrize("cell", CELLS)
def test_gaps_to_a_plane_are_the_distances_of_the_vertices(cell, degree):
    d = dimension(cell)
    _, contact, found = matched(cell, degree, tilted(d))
    gap, outward = contact.obstacle(found.coordinates.T)
    assert found.slave.size == 3 ** (d - 1)
    np.testing.assert_allclose(found.gap, gap, rtol=1e-13)
    np.testing.assert_allclose(found.normal, -outward.T)
    assert found.area.sum() == pytest.approx(1.0)
    assert (found.master == -1).all()


@both_degrees
def test_weight_of_the_measure(degree):
    found = [matched("quadrilateral", degree, tilted(2), weight)[2] for weight in (None, 3.0)]
    np.testing.assert_allclose(found[1].area, 3.0 * found[0].area)
    np.testing.assert_allclose(found[1].gap, found[0].gap)


def half(x):
    """A plane that ends at x = 0.6."""
    normal = np.zeros((2, x.shape[1]))
    normal[1] = 1.0
    return np.where(x[0] < 0.6, GAP, np.inf), normal


@both_degrees
def test_where_there_is_no_obstacle(degree):
    """In the deformed state conditions are where the obstacle is, as in the undeformed one."""
    _, contact, found = matched("quadrilateral", degree, half)
    there = np.isfinite(found.gap)
    assert sorted(found.coordinates[there, 0]) == pytest.approx([0.0, 0.5])
    space, _, whole = matched("quadrilateral", degree, tilted(2))
    new = deformed_contacts([(contact, whole)], fem.Function(space))[0].conditions
    there = np.isfinite(new.gap)
    assert sorted(new.coordinates[there, 0]) == pytest.approx([0.0, 0.5])


@both_degrees
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_gaps_in_the_deformed_state(cell, degree):
    """A body that moved as a whole has the same conditions, nearer to the obstacle."""
    d = dimension(cell)
    space, contact, before = matched(cell, degree, tilted(d))
    u = fem.Function(space)
    u.x.array.reshape(-1, d)[:, d - 1] = -0.1
    new = deformed_contacts([(contact, before)], u)[0]
    np.testing.assert_allclose(new.normal, before.normal)
    np.testing.assert_allclose(new.conditions.gap, before.gap, rtol=1e-12)
    np.testing.assert_allclose(new.distance, before.gap + 0.1 * before.normal[:, -1], rtol=1e-12)


def conditions(comm, cell, degree):
    """Return places, normals, gaps and areas, undeformed and deformed, in the order of places."""
    scene = pressed_block(comm, cell, 4)
    space, d = displacement_space(scene.mesh, degree), scene.mesh.geometry.dim
    ball = Sphere((0.3,) * (d - 1) + (-2.0,), 1.9)
    contact = RigidObstacle(scene.facet_tags, GROUND, lambda x: ball(x[:d])[0])
    (found,) = match_obstacles(MeshBoundary.of(space), [("ground", contact)], [None])
    u = fem.Function(space)
    u.interpolate(lambda x: np.stack([0.05 * x[k] ** 2 - 0.01 for k in range(d)]))
    new = deformed_contacts([(contact, found)], u)[0]
    columns = (found.coordinates, found.normal, found.gap, found.area)
    columns += (new.normal, new.conditions.gap, new.distance)
    rows = concatenate_ranks(comm, np.column_stack(columns))
    return rows[np.lexsort(np.round(rows[:, :3], 9).T)]


@pytest.mark.ranks(2)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_conditions_of_all_ranks(cell, degree):
    here, alone = (conditions(comm, cell, degree) for comm in (COMM, MPI.COMM_SELF))
    assert len(alone) == 5 ** (2 if "hedron" in cell else 1)
    np.testing.assert_allclose(here, alone, atol=1e-12)
