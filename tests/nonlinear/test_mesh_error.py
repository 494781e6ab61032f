"""The error of the mesh at finite strains: that of the problem linearised at the solution."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from mesh_errors import cells_at
from scenes import at

import ufl
from dolfinx import fem

from fenics_tfeti import InputError, NonlinearContactProblem, Plane, Sphere
from fenics_tfeti.models import neo_hookean

FOOT, TOP, LEFT = 1, 2, 3
COMM = MPI.COMM_SELF


def pressed(n, depth, round=True, cell="triangle", degree=1):
    """Return the half of a block that is pressed on a roller, or on a floor."""
    marks = [(FOOT, at(1, 0.0)), (TOP, at(1, 1.0)), (LEFT, at(0, 0.0))]
    parts = [((0.0, 0.0), (1.0, 1.0), (n, n))]
    scene = scenes.Scene.of_boxes(COMM, cell, parts, marks, degree=degree, young=1.0)
    scene.fix(LEFT, 0)
    scene.fix(TOP, 1, -depth)
    below = Sphere((0.0, -2.0), 2.0) if round else Plane((0.0, 0.0), (0.0, 1.0))
    scene.add_obstacle(FOOT, below, name="joint")
    u = fem.Function(scene.V)
    F = ufl.derivative(neo_hookean(1.0, 0.3)(u) * ufl.dx(degree=2 * degree), u, scene.v)
    options = {"newton_rtol": 1e-10}
    problem = NonlinearContactProblem(F, u, bcs=scene.bcs, contacts=scene.contacts, options=options)
    return problem, scene


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("quadrilateral", 1)])
def test_homogeneous_strain_has_none(cell, degree):
    problem, _ = pressed(3, 0.3, round=False, cell=cell, degree=degree)
    problem.solve()
    estimate = problem.mesh_error()
    # the root of the work that gaps of newton_rtol leave
    assert estimate.error < 1e-5
    assert estimate.linearised
    assert "of the linearised problem" in str(problem.report)


def test_as_that_of_the_linear_problem_for_small_strains():
    problem, scene = pressed(6, 1e-5)
    problem.solve()
    linear = scene.problem(cell_tags=None, options={"rtol": 1e-9})
    linear.solve()
    estimates = [each.mesh_error() for each in (problem, linear)]
    assert estimates[0].error == pytest.approx(estimates[1].error, rel=1e-3)
    errors = [each.cells.x.array for each in estimates]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-2, atol=1e-3 * errors[1].max())


def test_is_about_the_difference_to_a_finer_solution():
    """In the norm of the tangent, with a tenth of the block's height pressed in."""
    (problem, _), (fine, _) = pressed(4, 0.1), pressed(12, 0.1, degree=2)
    problem.solve()
    fine.solve()
    estimate = problem.mesh_error()
    W, coarse = fine.space, fem.Function(fine.space)
    x = W.tabulate_dof_coordinates()
    coarse.x.array[:] = problem.u.eval(x, cells_at(problem.space.mesh, x).astype(np.int32)).ravel()
    difference = fem.Function(W)
    difference.x.array[:] = fine.u.x.array - coarse.x.array
    F = ufl.derivative(neo_hookean(1.0, 0.3)(coarse) * ufl.dx, coarse, difference)
    square = fem.assemble_scalar(fem.form(ufl.derivative(F, coarse, difference)))
    assert 0.8 < estimate.error * estimate.energy_norm / np.sqrt(square) < 1.6


def test_needs_a_solution():
    with pytest.raises(InputError, match=r"^mesh_error\(\) is of a solution"):
        pressed(2, 0.1)[0].mesh_error()
