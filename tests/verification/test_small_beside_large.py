"""Small displacements beside large ones, and obstacles far away: each part as right as if alone.

The scripts are those of a user of dolfinx, with the default options unless said otherwise.
"""

import itertools

from mpi4py import MPI

import numpy as np
import pytest
from scenes import POISSON, YOUNG, Scene, at, axisymmetric_strain, elasticity, normal_forces

import ufl
from dolfinx import fem, mesh

from fenics_tfeti import Sphere
from fenics_tfeti.io import tag_facets

pytestmark = pytest.mark.once

# -- a soft body beside a stiff one that moves far -------------------------------------------------

FIXED, SQUEEZED, LOWER, UPPER, HELD, LIFTED = 1, 2, 3, 4, 5, 6
SQUEEZE, LIFT = 1e-4, 20e-3  # [m]


def pad_and_bar():
    """A pad of rubber, 0.1 m high and in two halves, is squeezed by 0.1 mm between plates.

    Beside it the end of a bar of steel, 1 m long, is lifted by 20 mm.
    """
    parts = [
        ((0, 0, 0), (0.1, 0.1, 0.05), (4, 4, 2)),
        ((0, 0, 0.05), (0.1, 0.1, 0.1), (4, 4, 2)),
        ((0.3, 0, 0), (1.3, 0.1, 0.1), (10, 2, 2)),
    ]
    marks = [
        (FIXED, at(2, 0.0), 1),
        (LOWER, at(2, 0.05), 1),
        (UPPER, at(2, 0.05), 2),
        (SQUEEZED, at(2, 0.1), 2),
        (HELD, at(0, 0.3), 3),
        (LIFTED, at(0, 1.3), 3),
    ]
    scene = Scene.of_boxes(MPI.COMM_SELF, "hexahedron", parts, marks)
    scene.a = of_pad(scene, scene.u, scene.v)
    scene.a += elasticity(scene.u, scene.v, 2.1e11, scene.dx(3), 0.3)
    scene.fix(FIXED)
    scene.fix(HELD)
    scene.fix(SQUEEZED, None, np.array([0.0, 0.0, -SQUEEZE]))
    scene.fix(LIFTED, 2, LIFT)
    scene.add_pair(UPPER, LOWER)
    return scene


def of_pad(scene, u, v):
    return elasticity(u, v, 1e6, scene.dx((1, 2)), 0.45)


def assert_beside(scene, exact, problem):
    """Compare what moves little and what moves far, and the energy of the pad's error."""
    uh = problem.solve()

    def at_facets(tag):
        dofs = fem.locate_dofs_topological(scene.V, 2, scene.facet_tags.find(tag))
        return uh.x.array.reshape(-1, 3)[dofs, 2]

    np.testing.assert_allclose(at_facets(SQUEEZED), -SQUEEZE, rtol=1e-12)
    np.testing.assert_allclose(at_facets(LIFTED), LIFT, rtol=1e-12)

    true, error = fem.Function(scene.V), fem.Function(scene.V)
    true.x.array[:] = exact.displacement
    error.x.array[:] = uh.x.array - true.x.array

    def energy(w):
        return fem.assemble_scalar(fem.form(of_pad(scene, w, w)))

    assert np.sqrt(energy(error) / energy(true)) <= problem.report.options["rtol"]
    assert problem.report.converged


def test_rubber_beside_steel_that_moves():
    scene = pad_and_bar()
    exact = scene.reference()
    for method, rtol in itertools.product(["active_set", "smalbe"], [{}, {"rtol": 1e-4}]):
        assert_beside(scene, exact, scene.problem(options={"method": method, **rtol}))


# -- a ball that is far away at its rim ------------------------------------------------------------

TOP, BOTTOM, SIDE = 1, 2, 3


BALL = 0.2  # radius [m]
DEPTHS = (1e-7, 1e-6, 1e-5)  # indentation [m]


def half_space(growth=1.2):
    """Return mesh and tags of a quarter plane of 0.2 m, whose elements grow from the corner on.

    The smallest ones are an eighth of the radius of contact at the first depth.
    """
    smallest = np.sqrt(BALL * DEPTHS[0]) / 8
    n = int(np.log(1 + 0.2 / smallest * (growth - 1)) / np.log(growth)) + 1
    corners = [np.array([0.0, 0.0]), np.array([1.0, 1.0])]
    kind = mesh.CellType.quadrilateral
    domain = mesh.create_rectangle(MPI.COMM_SELF, corners, [n, n], kind)
    x = domain.geometry.x
    x[:, :2] = 0.2 * (growth ** (n * x[:, :2]) - 1) / (growth**n - 1)
    return domain, tag_facets(domain, [(TOP, at(1, 0.2)), (BOTTOM, at(1, 0.0)), (SIDE, at(0, 0.0))])


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_first_steps_of_a_rigid_ball(method):
    """Hertz's force F = 4/3 E* sqrt(R) d^(3/2); gaps at the rim are 10^5 times the first depth.

    The mesh leaves 2 % at 6 elements on the radius of contact.
    """
    domain, tags = half_space()
    scene = Scene(domain, tags)
    weight = 2 * ufl.pi * ufl.SpatialCoordinate(domain)[0]
    scene.a = elasticity(scene.u, scene.v, YOUNG * weight, strain=axisymmetric_strain)
    depth = scene.constant(0.0)
    scene.fix(TOP, 1, depth)
    scene.fix(SIDE, 0)
    scene.add_obstacle(BOTTOM, Sphere((0.0, -BALL), BALL))
    problem = scene.problem(options={"method": method}, measure_weight=weight)
    for d in DEPTHS:
        depth.value = -d
        problem.solve()
        hertz = 4 / 3 * YOUNG / (1 - POISSON**2) * np.sqrt(BALL) * d**1.5
        assert problem.report.contacts[0].normal_force == pytest.approx(hertz, rel=0.02)


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_first_step_of_a_rigid_ball_on_a_coarse_mesh(method):
    """One node touches; the force is that of the same mesh solved directly."""
    parts = [((-0.1, -0.1, 0), (0.1, 0.1, 0.2), (8, 8, 8))]
    marks = [(TOP, at(2, 0.2)), (BOTTOM, at(2, 0.0))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "hexahedron", parts, marks)
    scene.fix(TOP, None, np.array([0.0, 0.0, -DEPTHS[0]]))
    scene.add_obstacle(BOTTOM, Sphere((0.0, 0.0, -BALL), BALL))
    options = {"method": method, "subdomain_size": 500}
    problem, exact = scene.problem(cell_tags=None, options=options), scene.reference()
    problem.solve()
    force = exact.contacts[0].forces
    assert np.count_nonzero(force) == np.count_nonzero(problem.results[0].active) == 1
    assert normal_forces(problem) == pytest.approx([force.sum()], rel=1e-6)
