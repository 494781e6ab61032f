"""27 loose blocks in a box: statics in closed form, and the problem solved as a whole."""

from __future__ import annotations

import itertools

from mpi4py import MPI

import numpy as np
import pytest
from scenes import Scene, at

import ufl
from dolfinx import fem
from dolfinx.fem import petsc

from fenics_tfeti import Plane

pytestmark = pytest.mark.once

PRESSURE, WEIGHT, POWER = 20e6, 24e4, 4
CUBES = [(i, j, k) for k, j, i in itertools.product(range(3), repeat=3)]
TOTAL = 1e8  # the scale of the loads [N]

# the demo of a stack is the small form
hexahedra = pytest.param("hexahedron", marks=pytest.mark.heavy)


def body_of(cube):
    """Return the number of a cube's cells."""
    return 1 + CUBES.index(tuple(int(i) for i in cube))


def face(cube, axis, end):
    """Return the tag of a face: end is 0 for the lower and 1 for the upper one."""
    return 10 * body_of(cube) + 2 * axis + end


def contacts_of_stack(with_walls=True):
    """Return (cubes, axis, end of the first) for the 54 pairs, then for the floor and the walls."""
    axes = np.eye(3, dtype=int)
    pairs, walls = [], []
    for cube, axis in itertools.product(CUBES, range(3)):
        next_one = tuple(cube + axes[axis])
        if next_one in CUBES:
            pairs.append(((next_one, cube), axis, 0))
        elif axis < 2 and with_walls:
            walls.append(((cube,), axis, 1))
        if cube[axis] == 0 and (axis == 2 or with_walls):
            walls.append(((cube,), axis, 0))
    return pairs + walls


def stack(cell, walls=True):
    """Return the stack under the pressure p (x y / 9)^4 on its top, and its own weight."""
    faces = itertools.product(CUBES, range(3), (0, 1))
    marks = [(face(c, i, end), at(i, c[i] + end), body_of(c)) for c, i, end in faces]
    parts = [(cube, np.add(cube, 1), (2, 2, 2)) for cube in CUBES]
    scene = Scene.of_boxes(MPI.COMM_SELF, cell, parts, marks)
    x, down = ufl.SpatialCoordinate(scene.mesh), -scene.v[2]
    top = tuple(face(cube, 2, 1) for cube in CUBES if cube[2] == 2)
    scene.L = scene.constant(WEIGHT) * down * scene.dx
    scene.L += PRESSURE * (x[0] * x[1] / 9) ** POWER * down * scene.ds(top)
    for (cube, *master), axis, end in contacts_of_stack(walls):
        if master:
            scene.add_pair(face(cube, axis, end), face(*master, axis, 1 - end))
        else:
            e = np.eye(3)[axis]
            scene.add_obstacle(face(cube, axis, end), Plane(3.0 * end * e, (1 - 2 * end) * e))
    return scene


def solved(cell):
    """Return scene, solved problem and displacement."""
    scene = stack(cell)
    problem = scene.problem(options={"rtol": 1e-9})
    return scene, problem, problem.solve()


def load_of_column(i, j):
    """Return the force on the top of a column [N]."""
    x, y = (
        3 / (POWER + 1) * (((k + 1) / 3) ** (POWER + 1) - (k / 3) ** (POWER + 1)) for k in (i, j)
    )
    return PRESSURE * x * y


def forces_on_blocks(scene, problem):
    """Return force and moment about the origin (27, 6) that load and contacts leave on a block."""
    left = np.zeros((27, 2, 3))

    def add(cube, points, forces):
        left[body_of(cube) - 1] += forces.sum(axis=0), np.cross(points, forces).sum(axis=0)

    f = petsc.assemble_vector(fem.form(scene.L)).array.reshape(-1, 3)
    x = scene.V.tabulate_dof_coordinates()
    scene.mesh.topology.create_connectivity(3, 3)
    for cube in CUBES:
        cells = scene.cell_tags.find(body_of(cube))
        nodes = fem.locate_dofs_topological(scene.V, 3, cells)
        add(cube, x[nodes], f[nodes])
    for found, (cubes, *_) in zip(problem.results, contacts_of_stack(), strict=True):
        for cube, sign in zip(cubes, (-1, 1), strict=False):
            add(cube, found.coordinates, sign * found.nodal_normal_force[:, None] * found.normal)
    return left.reshape(27, 6)


def test_each_face_between_two_blocks_is_a_pair():
    neighbours = [cubes for cubes, *_ in contacts_of_stack() if len(cubes) == 2]
    assert len(neighbours) == 54
    assert sum((1, 1, 1) in cubes for cubes in neighbours) == 6


def assert_statics(scene, problem):
    """Without friction the neighbours and the walls push sideways only."""
    layers = np.zeros(3)
    for found, (cubes, *_) in zip(problem.results, contacts_of_stack(), strict=True):
        i, j, k = cubes[0]
        if abs(found.normal[0, 2]) > 0.5:
            expected = load_of_column(i, j) + WEIGHT * (3 - k)
            assert found.nodal_normal_force.sum() == pytest.approx(expected, abs=1e-8 * TOTAL)
            layers[round(found.coordinates[0, 2])] += found.nodal_normal_force.sum()
    # three faces to a column have vertical normals, and each layer carries the whole load
    expected = PRESSURE * 9 / 25 + 9 * WEIGHT * (3 - np.arange(3))
    assert layers == pytest.approx(expected, abs=1e-8 * TOTAL)
    assert np.abs(forces_on_blocks(scene, problem)).max() <= 1e-8 * TOTAL, "equilibrium"


@pytest.mark.parametrize("cell", ["tetrahedron", hexahedra])
def test_stack(cell):
    """By the statics of the blocks, and by the problem solved as a whole."""
    scene, problem, uh = solved(cell)
    assert_statics(scene, problem)
    expected = scene.reference()
    error = np.linalg.norm(uh.x.array - expected.displacement)
    assert error <= 1e-7 * np.linalg.norm(expected.displacement)
    largest = max(contact.forces.max() for contact in expected.contacts)
    for found, contact in zip(problem.results, expected.contacts, strict=True):
        order = np.argsort(found.nodes)
        np.testing.assert_allclose(
            found.nodal_normal_force[order], contact.forces, rtol=0.0, atol=1e-7 * largest
        )
    # some nodes lift off: otherwise the inequalities might as well be equations
    forces = np.concatenate([contact.forces for contact in expected.contacts])
    assert 0 < np.count_nonzero(forces) < forces.size


@pytest.mark.parametrize("cell", ["tetrahedron", hexahedra])
def test_free_columns(cell):
    """Where nothing holds the sides, neighbours cannot press each other, and columns part.

    Few rows press and many do not, so a larger penalty than usual spares outer iterations.
    """
    problem = stack(cell, walls=False).problem(options={"rtol": 1e-8, "smalbe_rho": 10.0})
    problem.solve()
    for found, (cubes, *_) in zip(problem.results, contacts_of_stack(False), strict=True):
        i, j, k = cubes[0]
        vertical = abs(found.normal[0, 2]) > 0.5
        expected = load_of_column(i, j) + WEIGHT * (3 - k) if vertical else 0.0
        assert found.nodal_normal_force.sum() == pytest.approx(expected, abs=1e-8 * TOTAL)
    assert problem.report.free_motions
    assert problem.report.certificate.penetration <= 1e-8
