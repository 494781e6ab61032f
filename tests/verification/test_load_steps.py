"""A problem solved again after a change gives what a new problem gives, and reuses what it can."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CLAMPED, GROUND, SLAVE, Scene, at, normal_forces, two_beams
from stepped_blocks import (
    CHANGES,
    OPTIONS,
    added_wall,
    new_problem,
    nothing,
    round_floor,
    softer_and_larger_load,
    two_blocks_on_a_floor,
)

from fenics_tfeti import InputError, NotConverged, Plane, RigidObstacle
from fenics_tfeti.io import tag_facets

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.once


def assert_same(problem, uh, other, expected):
    np.testing.assert_allclose(
        uh.x.array, expected.x.array, atol=1e-7 * np.abs(expected.x.array).max()
    )
    assert len(problem.results) == len(other.results)
    for mine, theirs in zip(problem.results, other.results, strict=True):
        assert mine.name == theirs.name
        for name in ("nodes", "gap", "normal"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        np.testing.assert_allclose(
            mine.nodal_normal_force,
            theirs.nodal_normal_force,
            atol=1e-6 * theirs.nodal_normal_force.max(),
        )
    np.testing.assert_allclose(normal_forces(problem), normal_forces(other), rtol=1e-7, atol=1e-3)
    assert [c.matching for c in problem.report.contacts] == [
        c.matching for c in other.report.contacts
    ]


@pytest.mark.parametrize("change", CHANGES)
def test_solved_again_is_solved_anew(change):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    before = problem.solve().copy()
    reused = change(scene)
    problem.contacts = list(scene.contacts)
    uh = problem.solve()
    other = new_problem(scene)
    expected = other.solve()
    assert_same(problem, uh, other, expected)
    assert other.report.reused == []
    assert problem.report.reused == reused
    moved = np.abs(uh.x.array - before.x.array).max() / np.abs(uh.x.array).max()
    assert (moved > 1e-2) == (change is not nothing)


@pytest.mark.parametrize("change", [softer_and_larger_load, added_wall])
def test_changed_before_the_first_solve(change):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    change(scene)
    problem.contacts = list(scene.contacts)
    other = new_problem(scene)
    assert_same(problem, problem.solve(), other, other.solve())


def test_there_and_back():
    """Without friction there is no history."""
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    first = problem.solve().x.array.copy()
    for factor in (1.5, 0.2, 1.0):
        scene.traction.value = factor * -2e7
        last = problem.solve().x.array
    np.testing.assert_allclose(last, first, atol=1e-7 * np.abs(first).max())


def test_results_of_earlier_steps_stay():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    first, contact, report = problem.solve(), problem.results, problem.report
    force = contact[0].nodal_normal_force.copy()
    scene.traction.value *= 2.0
    assert problem.solve() is first
    assert problem.results is not contact
    np.testing.assert_array_equal(contact[0].nodal_normal_force, force)
    assert report.reused == []


def test_warm_start_spares_products():
    """On a round floor, where a cold solve has to find out who touches."""
    scene = two_blocks_on_a_floor(n=16)
    round_floor(scene)
    problem = new_problem(scene, rtol=1e-6)
    problem.solve()
    scene.traction.value *= 1.1
    problem.solve()
    other = new_problem(scene, rtol=1e-6)
    other.solve()
    assert problem.report.products["total"] <= 0.75 * other.report.products["total"]


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_start_that_is_nearly_right(method):
    """A floor far away makes the first tolerances so large that the start is below them.

    Passes that have nothing to do are no sign that rounding limits the accuracy.
    """
    scene = two_beams(MPI.COMM_SELF, "hexahedron", 3, gap=1e-3)
    floor = RigidObstacle(scene.facet_tags, SLAVE, Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    contacts = [*scene.contacts, floor]
    options = {"rtol": 1e-3, "method": method}
    problem, load = scene.problem(contacts=contacts, options=options), scene.traction
    first = float(load.value)
    for step in range(6):
        load.value = first * (1.0 + 0.01 * step)
        problem.solve()
        assert problem.report.converged
        force = sum(c.normal_force for c in problem.report.contacts)
        assert force == pytest.approx(scene.total_forces[0] * (1.0 + 0.01 * step), rel=1e-6)


def test_seconds_and_products_are_those_of_the_step():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    problem.solve()
    assert problem.report.products["norm"] > 0
    problem.solve()
    report = problem.report
    assert report.products["norm"] == 0 and report.products["total"] <= 3
    assert "partition" not in report.seconds and "compilation" not in report.seconds
    assert "factors" in report.reused


@pytest.mark.parametrize("what", ["traction", "young", "shift"])
def test_nan_is_noticed_and_forgiven(what):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    before = problem.solve().x.array.copy()
    constant = getattr(scene, what)
    right = float(constant.value)
    constant.value = np.nan
    with pytest.raises(InputError, match="NaN"):
        problem.solve()
    constant.value = right
    np.testing.assert_allclose(problem.solve().x.array, before, atol=1e-7 * np.abs(before).max())


def test_contact_removed():
    scene = two_blocks_on_a_floor()
    before = list(scene.contacts)
    added_wall(scene)
    problem = new_problem(scene)
    problem.solve()
    problem.contacts = scene.contacts = before
    uh = problem.solve()
    other = new_problem(scene)
    assert_same(problem, uh, other, other.solve())


def test_load_taken_away():
    """Nothing pushes: nothing moves, up to the last digit."""
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    problem.solve()
    scene.traction.value = scene.shift.value = 0.0
    assert not problem.solve().x.array.any()
    assert problem.report.converged


def test_step_without_convergence_can_be_repeated():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene, max_products=3)
    with pytest.raises(NotConverged):
        problem.solve()
    of_solver = replace(problem.options.solver, max_products=1000)
    problem.options = replace(problem.options, solver=of_solver)
    uh = problem.solve()
    other = new_problem(scene)
    assert_same(problem, uh, other, other.solve())


def test_step_that_fails_leaves_the_last_one():
    """The load and the displacement of the last step that was accepted."""
    scene, loads = two_blocks_on_a_floor(n=4), []
    problem = new_problem(scene)

    def set_load(t):
        loads.append(t)
        scene.traction.value = -2e7 * t
        of_solver = replace(problem.options.solver, max_products=3 if t == 1.0 else 1000)
        problem.options = replace(problem.options, solver=of_solver)

    with pytest.raises(NotConverged, match="load step from 0.9985 to 1 "):
        for _ in problem.steps(set_load, 0.0, 1.0, first=0.9985):
            accepted = problem.u.x.array.copy()
    assert loads == [0.9985, 1.0, 0.9985]
    np.testing.assert_array_equal(problem.u.x.array, accepted)


def test_contacts_joined():
    """The same rows, now of one contact."""
    parts = [((2 * k, 0), (2 * k + 1, 1), (3, 3)) for k in (0, 1)]
    marks = [(CLAMPED, at(1, 1.0)), (SLAVE, at(1, 0.0), 1), (GROUND, at(1, 0.0), 2)]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks)
    whole = tag_facets(scene.mesh, [(SLAVE, at(1, 0.0))])
    scene.fix(CLAMPED, None, np.array([0.0, -1e-3]))
    for tag in (SLAVE, GROUND):
        scene.add_obstacle(tag, floor := Plane((0, 0), (0, 1)))
    problem = scene.problem(cell_tags=None, options=OPTIONS)
    problem.solve()
    two = normal_forces(problem)
    problem.contacts = [RigidObstacle(whole, SLAVE, floor)]
    problem.solve()
    np.testing.assert_allclose(normal_forces(problem), [sum(two)], rtol=1e-7)


def by_place(problem, uh):
    """Return the displacements of this rank's nodes by place; the bodies are apart."""
    places = np.round(problem.space.tabulate_dof_coordinates()[:, :2], 7) + 0.0
    return dict(zip(map(tuple, places), uh.x.array.reshape(-1, 2), strict=True))


def stepped(comm, change):
    scene = two_blocks_on_a_floor(comm)
    problem = new_problem(scene)
    problem.solve()
    reused = change(scene)
    problem.contacts = list(scene.contacts)
    return problem, problem.solve(), reused


@pytest.mark.ranks(2)
@pytest.mark.parametrize("change", [softer_and_larger_load, added_wall])
def test_second_step_is_that_of_one_rank(change):
    problem, uh, reused = stepped(COMM, change)
    alone, expected, _ = stepped(MPI.COMM_SELF, change)
    assert problem.report.reused == reused
    largest = np.abs(expected.x.array).max()
    values = by_place(alone, expected)
    for place, value in by_place(problem, uh).items():
        np.testing.assert_allclose(value, values[place], atol=1e-7 * largest)
    np.testing.assert_allclose(normal_forces(problem), normal_forces(alone), rtol=1e-6, atol=1e-3)


@pytest.mark.ranks(2)
def test_nan_on_one_rank_is_raised_on_all():
    scene = two_blocks_on_a_floor(COMM)
    problem = new_problem(scene)
    problem.solve()
    right = float(scene.traction.value)
    if COMM.rank == COMM.size - 1:
        scene.traction.value = np.nan
    with pytest.raises(InputError, match="NaN"):
        problem.solve()
    scene.traction.value = right
    problem.solve()
    assert problem.report.converged
