"""What is loaded no more is at rest, and tiny loads have tiny answers; coordinates are rounded."""

from mpi4py import MPI

import numpy as np
import pytest
from finite_strains import indented_block
from scenes import LOADED, MASTER, ROLLER, SLAVE, Scene, at

from dolfinx import fem

from fenics_tfeti import Coulomb, Deformed, Plane

pytestmark = pytest.mark.once

ANGLE = 0.3


def is_at_rest(problem):
    """Tell whether nothing moves and nothing presses."""
    return np.abs(problem.u.x.array).max() < 1e-12 and not problem.results[0].force.any()


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_die_that_is_withdrawn(cell):
    """The block is at rest, which a further step finds at once."""
    scene = indented_block(n=4, cell=cell, turned=ANGLE)
    for parts in ([0.3, 0.0, -0.1], [-0.2]):
        scene.solve(parts)
        assert is_at_rest(scene.problem)
    assert scene.counts()[0] == 1


def test_tiny_loads():
    """The force grows with the depth of a plane as soon as that is more than rounding."""
    forces = []
    for depth in (1e-11, 1e-6):
        scene = indented_block(n=4, cell="triangle", obstacle=Plane((0, 1 - depth), (0, -1)))
        scene.solve([1.0])
        forces.append(scene.problem.results[0].force[1] / depth)
    assert forces[0] == pytest.approx(forces[1], rel=1e-3)


@pytest.mark.parametrize("friction", [None, Coulomb(0.3)])
def test_block_that_is_lifted(friction):
    """With exact non-penetration, on surfaces that do not lie along the axes."""
    parts = [((-1, 0), (1, 1), (4, 2)), ((-0.5, 1), (0.5, 1.5), (3, 2))]
    marks = [(ROLLER, at(1, 0.0)), (LOADED, at(1, 1.5)), (MASTER, at(1, 1.0), 1)]
    marks += [(SLAVE, at(1, 1.0), 2)]
    turn = np.array([[np.cos(ANGLE), -np.sin(ANGLE)], [np.sin(ANGLE), np.cos(ANGLE)]])
    bodies = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, lambda x: turn @ x)
    lift = fem.Constant(bodies.mesh, np.zeros(2))
    bodies.fix(ROLLER)
    bodies.fix(LOADED, value=lift)
    bodies.add_pair(friction=friction)
    problem = bodies.problem(gaps=Deformed())
    for height in (-0.02, 0.0, 0.01, 0.0):
        lift.value[:] = turn @ [0.3 * height, height]
        problem.solve()
        problem.reset_slip()
        assert height != 0.0 or is_at_rest(problem)
