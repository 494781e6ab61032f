"""What the user gets where Newton's method cannot be posed, or finds no equilibrium."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from finite_strains import BASE, TOP, indented_block

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    InputError,
    NonlinearContactProblem,
    NotConverged,
    UnresistedMotion,
)
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import neo_hookean
from fenics_tfeti.newton.iteration import NewtonStep

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD


@pytest.fixture
def scene():
    """A block that is not loaded yet."""
    return indented_block(n=4)


def residual(scene, energy=None):
    """Return the residual of an energy, by default a quadratic one, of a scene's displacement."""
    u, V = scene.problem.u, scene.problem.space
    energy = ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx if energy is None else energy
    return ufl.derivative(energy, u, ufl.TestFunction(V))


def test_residual_without_u(scene):
    u, V = scene.problem.u, scene.problem.space
    other = fem.Function(V)
    with pytest.raises(InputError, match="F does not depend on u"):
        NonlinearContactProblem(residual(scene), other)
    bilinear = ufl.inner(ufl.TrialFunction(V), ufl.TestFunction(V)) * ufl.dx
    with pytest.raises(InputError, match="F has 2 arguments"):
        NonlinearContactProblem(bilinear, u)
    of_degree_2 = fem.Function(displacement_space(V.mesh, 2))
    energy = ufl.inner(ufl.grad(of_degree_2), ufl.grad(ufl.TestFunction(V))) * ufl.dx
    with pytest.raises(InputError, match="not on the function space of the test function"):
        NonlinearContactProblem(energy, of_degree_2)
    with pytest.raises(InputError, match="u is a str"):
        NonlinearContactProblem(residual(scene), "u")


def test_tangent_that_is_not_symmetric(scene):
    """It is no error, as pressures that follow the surface have one: the equilibrium is that of F.

    The minimum of a quadratic energy, also with a tangent that is not its second derivative.
    """
    u, V, bcs = scene.problem.u, scene.problem.space, scene.problem.bcs
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    F = residual(scene) - 0.1 * v[0] * ufl.dx
    tangent = ufl.derivative(F, u, du)
    found = []
    for J in (tangent, tangent + 0.2 * ufl.inner(du[0].dx(1), v[1]) * ufl.dx):
        u.x.array[:] = 0.0
        NonlinearContactProblem(F, u, bcs=bcs, J=J, options={"newton_rtol": 1e-8}).solve()
        found.append(u.x.array.copy())
    np.testing.assert_allclose(found[1], found[0], atol=1e-7 * np.abs(found[0]).max())


def test_gap_in_place_of_the_measured_one(scene):
    u, tags = scene.problem.u, scene.problem.contacts[0].facet_tags
    pair = ContactPair(tags, slave=2, master=BASE, initial_gap=0.1)
    with pytest.raises(InputError, match="NonlinearContactProblem measures gaps"):
        NonlinearContactProblem(residual(scene), u, contacts=[pair])


def test_start_with_inverted_cells(scene):
    scene.problem.u.interpolate(lambda x: np.array([0.0 * x[0], -1.5 * x[1]]))
    with pytest.raises(InputError, match=r"u cannot be the start .* the cell at \(.*is inverted"):
        scene.problem.solve()


def test_residual_that_is_nan(scene):
    u, contacts = scene.problem.u, scene.problem.contacts
    F = residual(scene, ufl.sqrt(ufl.inner(ufl.grad(u), ufl.grad(u))) * ufl.dx(degree=2))
    problem = NonlinearContactProblem(F, u, bcs=scene.problem.bcs, contacts=contacts)
    with pytest.raises(InputError, match="u cannot be the start .* the residual F is NaN"):
        problem.solve()


def test_tangent_that_is_infinite(scene):
    u, contacts = scene.problem.u, scene.problem.contacts
    F = residual(scene, (ufl.inner(ufl.grad(u), ufl.grad(u)) + u[0] ** 1.5) * ufl.dx(degree=2))
    problem = NonlinearContactProblem(F, u, bcs=scene.problem.bcs, contacts=contacts)
    with pytest.raises(InputError, match=r"the tangent is NaN or infinite .* around \("):
        problem.solve()


def test_nothing_converges_in_two_steps():
    scene = indented_block(n=4, newton_max_it=2)
    scene.set_load(0.3)
    scene.problem.u.x.array[:] = 0.0
    with pytest.raises(
        NotConverged, match=r"after 2 steps of Newton's method \(newton_max_it\)"
    ) as caught:
        scene.problem.solve()
    least = min(step.residual for step in scene.problem.report.newton)
    assert str(caught.value).startswith("no equilibrium") and f"{least:.1e}" in str(caught.value)
    (name,) = [contact.name for contact in scene.problem.report.contacts]
    assert f"surfaces are farthest from touching at {name}" in str(caught.value)
    assert not scene.problem.u.x.array.any()
    assert len(scene.problem.report.newton) == 2
    assert not scene.problem.report.converged


def test_step_that_fails_leaves_the_last_one(tmp_path):
    """A checkpoint after it has the displacement that u has."""
    scene = indented_block(n=4)
    scene.solve([0.25])
    accepted = scene.problem.u.x.array.copy()
    scene.problem.options = replace(scene.problem.options, newton_max_it=1)
    scene.set_load(1.0)
    with pytest.raises(NotConverged):
        scene.problem.solve()
    scene.problem.save(tmp_path / "step")
    other = indented_block(n=4)
    assert other.problem.restore(tmp_path / "step") == 1
    np.testing.assert_array_equal(other.problem.u.x.array, accepted)


def straight_column(is_guided):
    """Return a column on elastic ground under ten times its buckling load, free or guided."""
    mesh = boxes(COMM, [Box((0, 0), (1, 10), (2, 20))], "quadrilateral").mesh
    tags = tag_facets(
        mesh, {BASE: lambda x: np.isclose(x[1], 0), TOP: lambda x: np.isclose(x[1], 10)}
    )
    V = displacement_space(mesh)
    u, v = fem.Function(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    energy = neo_hookean(1.0, 0.3)(u) * ufl.dx + 0.5 * ufl.inner(u, u) * ds(BASE)
    F = ufl.derivative(energy, u, v) + 0.02 * v[1] * ds(TOP)
    lateral = V.sub(0)
    axis = fem.locate_dofs_geometrical(
        (lateral, lateral.collapse()[0]), lambda x: np.isclose(x[0], 0.5)
    )
    guide = fem.dirichletbc(fem.Function(lateral.collapse()[0]), axis, lateral)
    problem = NonlinearContactProblem(
        F, u, bcs=guide if is_guided else None, options={"newton_rtol": 1e-10}
    )
    problem.solve()
    return u.x.array


def test_straight_column_on_elastic_ground_above_its_buckling_load():
    """Its exact tangent is not positive; without a disturbance it is in equilibrium."""
    np.testing.assert_allclose(straight_column(False), straight_column(True), atol=1e-8)


def test_obstacle_that_no_step_can_reach():
    """It cannot be evaluated where anything has moved."""

    def obstacle(x):
        moved = np.abs(x[1] - 1.0).max() > 1e-14
        return np.full(x.shape[1], np.nan if moved else -0.1)

    scene = indented_block(n=4, obstacle=obstacle)
    with pytest.raises(NotConverged, match=r"cannot go on.*gap is NaN"):
        scene.problem.solve()
    assert not scene.problem.u.x.array.any()


def test_obstacle_that_long_steps_cannot_reach():
    last = []

    def plane(x):
        far = bool(last) and np.abs(x[1] - last[-1]).max() > 0.15
        last.append(last[-1] if far else x[1].copy())
        return np.full(x.shape[1], np.nan) if far else 0.8 - x[1]

    scene = indented_block(n=4, obstacle=plane)
    scene.problem.solve()
    lengths = [step.length for step in scene.problem.report.newton]
    assert lengths[0] == 0.5
    assert lengths[-1] == 1.0


def steps_to_uniform(gradient, limit, energy=None):
    """Return the Newton steps to a uniform gradient, each part of which is in equilibrium."""
    scene = indented_block(n=4)
    u, V = scene.problem.u, scene.problem.space
    end = fem.Function(V)
    end.interpolate(lambda x: np.array(gradient) @ x[:2])
    edge = fem.locate_dofs_geometrical(V, lambda x: (abs(x[0]) > 0.99) | (abs(x[1] - 0.5) > 0.49))
    bc, options = fem.dirichletbc(end, edge), {"newton_rtol": 1e-3}
    F = residual(scene, energy and energy(u) * ufl.dx)
    problem = NonlinearContactProblem(F, u, bcs=bc, options=options)
    problem.options = replace(problem.options, newton_step_limit=limit)
    problem.solve()
    return problem.report.newton


@pytest.mark.parametrize("limit", [0.3, 0.25])
def test_steps_are_cut_where_cells_would_change_too_much(limit):
    steps = steps_to_uniform([[-0.54, 0.0], [0.0, 0.0]], limit)
    second = limit * (1 - limit) / (0.54 - limit)
    assert [step.length for step in steps] == pytest.approx([limit / 0.54, second, 1.0], rel=1e-3)


@pytest.mark.filterwarnings("ignore:.*displacements of degree 1 lock")
def test_simple_shear_of_rubber_is_not_cut_for_its_volume():
    steps = steps_to_uniform([[0.0, 0.5], [0.0, 0.0]], 0.3, neo_hookean(1.0, 0.499))
    assert [step.length for step in steps[:2]] == pytest.approx([0.6, 1.0], rel=1e-3)


def test_contact_that_opens_and_closes():
    steps = []

    def obstacle(x):
        return np.full(x.shape[1], -((-1.0) ** len(steps)) * 0.1) + (1.0 - x[1])

    def count(step):
        if isinstance(step, NewtonStep):
            steps.append(step)

    scene = indented_block(n=4, obstacle=obstacle, newton_max_it=6)
    with pytest.raises(NotConverged, match=r"contact at \d+ nodes opens and closes in turn"):
        scene.problem.solve(monitor=count)


def test_body_that_nothing_holds():
    scene = indented_block(n=4)
    u, V = scene.problem.u, scene.problem.space
    weight = ufl.inner(fem.Constant(V.mesh, np.array([1e-3, 0.0])), u) * ufl.dx
    F = residual(scene, neo_hookean(1.0, 0.3)(u) * ufl.dx - weight)
    problem = NonlinearContactProblem(F, u, contacts=scene.problem.contacts)
    with pytest.raises(UnresistedMotion):
        problem.solve()
    assert not u.x.array.any()


def test_body_that_is_pushed_away():
    """It keeps no stress, and no force is left to compare the residual with."""
    scene = indented_block(n=4)
    scene.problem.bcs = []
    scene.solve([1.0])
    assert scene.problem.u.x.array[1::2] == pytest.approx(-0.3, abs=1e-6)
    assert scene.energy < 1e-12


def test_advance_and_save_without_a_solution(scene, tmp_path):
    with pytest.raises(InputError, match="no step to accept"):
        scene.problem.advance()
    with pytest.raises(InputError, match="nothing to save"):
        scene.problem.save(tmp_path / "none")
