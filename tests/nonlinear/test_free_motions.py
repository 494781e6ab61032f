"""Motions that nothing resists, at finite strains: told, small, and named where they go on."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, LOADED, MASTER, ROLLER, SLAVE, Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, NotConverged, Plane
from fenics_tfeti.models import neo_hookean

pytestmark = pytest.mark.once


def problem_of(bodies, load=0.0):
    """Return equilibrium of a material with a stiffness of 1, pressed from above."""
    u = fem.Function(bodies.V)
    energy = neo_hookean(1.0, 0.3)(u) * ufl.dx + load * u[1] * bodies.ds(LOADED)
    residual = ufl.derivative(energy, u, bodies.v)
    return NonlinearContactProblem(residual, u, bcs=bodies.bcs, contacts=bodies.contacts)


@pytest.mark.ranks(2)
@pytest.mark.parametrize("is_held", [False, True])
def test_block_between_planes(is_held):
    """Without stress, and with that of the planes."""
    marks = [(GROUND, at(1, 0.0)), (LOADED, at(1, 1.0)), (ROLLER, at(0, 0.0))]
    bodies = Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", [((0, 0), (1.2, 1), (6, 4))], marks)
    bodies.add_obstacle(GROUND, Plane((0, 0), (0, 1)))
    bodies.add_obstacle(LOADED, Plane((0, 0.99), (0, -1)))
    if is_held:
        bodies.fix(ROLLER, 0)
    problem = problem_of(bodies)
    problem.solve()
    told = problem.report.free_motions
    assert [text.split(": ")[1] for text in told] == ["translation along (1, 0)"] * (not is_held)


@pytest.mark.parametrize("width", [0.6, 1.0])
def test_block_on_a_block(width):
    """One slides by less than a facet to where it is in equilibrium, the other is named."""
    parts = [((0, 0), (1, 1), (3, 3)), ((0.5 - width / 2, 1), (0.5 + width / 2, 2), (3, 3))]
    marks = [(GROUND, at(1, 0.0)), (LOADED, at(1, 2.0)), (MASTER, at(1, 1.0), 1)]
    marks += [(SLAVE, at(1, 1.0), 2)]
    bodies = Scene.of_boxes(MPI.COMM_SELF, "triangle", parts, marks)
    bodies.fix(GROUND)
    bodies.add_pair()
    problem = problem_of(bodies, 1e-3)
    if width < 1.0:
        problem.solve()
        assert "body 1" in problem.report.free_motions[0]
    else:
        with pytest.raises(NotConverged, match=r"^hold what .*\(body 1 .*translation along \(1, "):
            problem.solve()
    assert np.abs(problem.u.x.array).max() < 0.02


@pytest.mark.ranks(2)
def test_weight_rolls_a_disc_onto_its_facet():
    """Rolling is no free motion of a body with facets, which turns until one of them lies flat."""
    tilt = 0.05

    def rounded(x):
        x, y = x[0] * np.sqrt(1 - x[1] ** 2 / 2), x[1] * np.sqrt(1 - x[0] ** 2 / 2)
        c, s = np.cos(tilt), np.sin(tilt)
        return np.stack([c * x - s * y, s * x + c * y])

    marks, box = [(GROUND, at(1, -1.0)), (LOADED, at(1, 1.0))], ((-1, -1), (1, 1), (5, 5))
    bodies = Scene.of_boxes(MPI.COMM_WORLD, "quadrilateral", [box], marks, rounded)
    bodies.add_obstacle(GROUND, Plane((0, -1), (0, 1)))
    problem = problem_of(bodies, 1e-5)
    problem.solve()
    V, u = bodies.V, problem.u
    owned = V.dofmap.index_map.size_local
    x = V.tabulate_dof_coordinates()[:owned, :2]
    moved = x + u.x.array[: 2 * owned].reshape(x.shape)
    sums = [np.sum(x * moved[:, ::-1] * (1, -1)), np.sum(x * moved)]
    rolled = np.arctan2(*bodies.mesh.comm.allreduce(np.array(sums)))
    assert rolled == pytest.approx(-tilt, rel=1e-6)
    told = problem.report.free_motions
    assert [text.split(": ")[1] for text in told] == ["translation along (1, 0)"]
