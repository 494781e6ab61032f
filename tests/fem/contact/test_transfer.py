"""Contact of a coarse mesh as the start on a fine one."""

from dataclasses import replace
from functools import lru_cache

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from matching import match_contacts
from moved_blocks import CELLS, blocks, lifted
from scenes import block_on_ball, normal_forces, two_beams

from fenics_tfeti import Deformed, InputError, Plane
from fenics_tfeti.fem.contact.conditions.contact_conditions import Terms
from fenics_tfeti.fem.contact.solution.results import ContactEntry, ContactResult
from fenics_tfeti.fem.contact.solution.transfer import expected_contact, gather_solved
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary

every_cell = pytest.mark.parametrize("cell", CELLS)
COMM = MPI.COMM_WORLD


def linear(x):
    """A function that facets of any shape represent exactly."""
    return 3.0 + 2.0 * x[:, 0] - x[:, 1]


def result_of(matched, pressure):
    return ContactResult(
        matched.name,
        ContactEntry(matched.name, 0.0, [], [], [], [], 0.0, {}),
        matched.slave,
        matched.slave,
        matched.coordinates,
        matched.gap,
        np.zeros_like(matched.gap),
        matched.normal,
        pressure * matched.area,
        pressure,
        pressure * matched.stretch,
        pressure > 0.0,
        matched.area,
        np.ones_like(pressure),
    )


def stretched(conditions, factor):
    """Return conditions of surfaces whose area is larger by a factor."""
    larger = replace(conditions, area=factor * conditions.area)
    vars(larger)["stretch"] = factor
    return larger


def transferred(coarse, contact, fine_match, displacement, pressure=linear, stretch=1.0):
    """Return what the fine mesh expects of the solution of a coarse one."""
    matched = match_contacts(MeshBoundary.of(coarse.V), [contact])[0]
    matched = stretched(matched, stretch)
    result = result_of(matched, pressure(matched.coordinates))
    solved = gather_solved([matched], [result], displacement)
    return expected_contact(solved, fine_match)


@every_cell
def test_linear_pressure_is_transferred_exactly(cell):
    coarse, fine = blocks(cell, n=2), blocks(cell, n=4)
    matched = fine.conditions(fine.pair)
    guess = transferred(coarse, coarse.pair, [matched], coarse.displacement())
    expected = linear(matched.coordinates) * matched.area
    np.testing.assert_allclose(guess.normal_force, expected, rtol=1e-12)


def test_forces_are_transferred_between_states():
    """The coarse surface is twice as large as the undeformed one, the fine one three times."""
    coarse, fine = blocks("quadrilateral", n=2), blocks("quadrilateral", n=4)
    matched = fine.conditions(fine.pair)
    present = stretched(matched, 3.0)
    guess = transferred(coarse, coarse.pair, [present], coarse.displacement(), stretch=2.0)
    expected = 2.0 * linear(matched.coordinates) * matched.area
    np.testing.assert_allclose(guess.normal_force, expected, rtol=1e-12)


@every_cell
def test_linear_approach_closes_the_gap_of_the_fine_mesh(cell):
    """The slave goes down by 0.02 (1 + x), the master up by 0.01."""
    coarse, fine = blocks(cell, n=2), blocks(cell, n=4)
    matched = fine.conditions(fine.pair)
    moved = coarse.displacement(
        lifted(lambda *x: 0.01 + 0.0 * x[0]), lifted(lambda *x: -0.02 * (1.0 + x[0]))
    )
    guess = transferred(coarse, coarse.pair, [matched], moved)
    approach = 0.01 + 0.02 * (1.0 + matched.coordinates[:, 0])
    np.testing.assert_allclose(guess.gap, matched.gap - approach, atol=1e-14)


@every_cell
def test_obstacle(cell):
    coarse, fine = blocks(cell, n=2), blocks(cell, n=4)
    up = np.eye(coarse.mesh.geometry.dim)[-1]
    floor = Plane(-0.5 * up, up)
    matched = fine.conditions(fine.obstacle(floor))
    moved = coarse.displacement(lifted(lambda *x: -0.1 * x[0]))
    guess = transferred(coarse, coarse.obstacle(floor), [matched], moved)
    np.testing.assert_allclose(guess.gap, 0.5 - 0.1 * matched.coordinates[:, 0], atol=1e-14)
    np.testing.assert_allclose(guess.normal_force / matched.area, linear(matched.coordinates))


@every_cell
def test_nodes_without_partner_say_nothing(cell):
    """A quarter of the coarse slave nodes have none: nothing leaks in, and gaps stay open."""
    coarse, fine = blocks(cell, n=4), blocks(cell, n=8)
    matched = coarse.conditions(coarse.pair)
    some = matched.coordinates[:, 0] < 1.8
    part = replace(
        matched,
        terms=Terms.of_nodes(matched.slave[some], matched.master[some]),
        normal=matched.normal[some],
        gap=matched.gap[some],
        area=matched.area[some],
    )
    result = result_of(part, np.ones(some.sum()))
    moved = coarse.displacement(lifted(lambda *x: 0.01 + 0.0 * x[0]))
    solved = gather_solved([part], [result], moved)
    there = fine.conditions(fine.pair)
    guess = expected_contact(solved, [there])
    near = there.coordinates[:, 0] < 2.0 - 1e-9
    np.testing.assert_allclose(guess.normal_force[near], there.area[near])
    np.testing.assert_allclose(guess.gap[near], there.gap[near] - 0.01, atol=1e-14)
    assert not guess.normal_force[~near].any()
    assert np.isinf(guess.gap[~near]).all()


@every_cell
def test_fewer_products_and_the_same_solution(cell):
    coarse, fine, alone = (scenes.block_on_ball(COMM, cell, n).problem() for n in (4, 8, 8))
    coarse.solve()
    uh, expected = fine.solve(coarse=coarse), alone.solve()
    assert fine.report.products["total"] < alone.report.products["total"]
    assert fine.report.reused == ["contact guess"]
    largest = np.abs(expected.x.array).max()
    np.testing.assert_allclose(uh.x.array, expected.x.array, atol=1e-5 * largest)


def test_own_solution_is_the_first_face():
    """A finer mesh is a start as well, and so is the same one."""
    problem, again = (scenes.block_on_ball(COMM, "quadrilateral", 16).problem() for _ in range(2))
    problem.solve()
    again.solve(coarse=problem)
    assert again.report.faces[0].active == problem.report.unknowns["active"]
    assert [face.changed for face in again.report.faces] == [0] * len(again.report.faces)


def test_contacts_may_be_in_another_order():
    scene = scenes.block_on_ball(COMM, "quadrilateral", 16)
    far = replace(scene.contacts[0], obstacle=Plane((0, -9), (0, 1)), name="far")
    problem = scene.problem(contacts=[*scene.contacts, far])
    again = scene.problem(contacts=[far, *scene.contacts])
    problem.solve()
    again.solve(coarse=problem)
    assert [face.changed for face in again.report.faces] == [0] * len(again.report.faces)
    other = scene.problem(contacts=[replace(far, name="near"), *scene.contacts])
    with pytest.raises(InputError, match=r"has the contacts .*'far'.*, this one has .*'near'"):
        other.solve(coarse=problem)


def test_exact_non_penetration_starts_from_it_too():
    coarse, fine, alone = (
        scenes.block_on_ball(COMM, "quadrilateral", n).problem(gaps=Deformed()) for n in (8, 16, 16)
    )
    coarse.solve()
    uh, expected = fine.solve(coarse=coarse), alone.solve()
    assert fine.report.passes[0].products < alone.report.passes[0].products
    np.testing.assert_allclose(uh.x.array, expected.x.array, atol=1e-7)


def test_load_steps_on_both_meshes():
    """The set is that of the coarse mesh at the present load, the multipliers the last ones."""
    coarse, fine = (scenes.two_beams(COMM, "quadrilateral", n) for n in (4, 8))
    problems = coarse.problem(), fine.problem()
    for load in (1.0, 0.1):
        for scene in (coarse, fine):
            scene.traction.value = -load * scenes.TRACTION
        problems[0].solve()
        problems[1].solve(coarse=problems[0])
    assert problems[1].report.reused[-2:] == ["multipliers", "contact guess"]
    np.testing.assert_allclose(
        normal_forces(problems[1]), [0.1 * force for force in fine.total_forces], rtol=1e-5
    )


OPTIONS = {"subdomain_size": 200}
SCENES = {
    "beams, quadrilaterals": lambda comm, n: two_beams(comm, "quadrilateral", 4 * n),
    "beams, tetrahedra": lambda comm, n: two_beams(comm, "tetrahedron", 2 * n),
    "ball, hexahedra": lambda comm, n: block_on_ball(comm, "hexahedron", 4 * n),
}
every_scene = pytest.mark.parametrize("name", SCENES)


def problem_on(comm, name, n):
    return SCENES[name](comm, n).problem(options=OPTIONS)


@lru_cache(maxsize=None)
def started(name, coarse_alone=False, alone=False):
    """Return the fine problem, solved; of which the meshes are on one rank."""
    coarse = problem_on(MPI.COMM_SELF if coarse_alone else COMM, name, 1)
    coarse.solve()
    fine = problem_on(MPI.COMM_SELF if alone else COMM, name, 2)
    fine.solve(coarse=coarse)
    return fine


@pytest.mark.ranks(2)
@every_scene
def test_first_face_is_that_of_one_rank(name):
    face, expected = started(name).report.faces[0], started(name, True, True).report.faces[0]
    assert face.active == expected.active


def changes_of_the_set(problem):
    """Return how many faces were found wrong; a right one may be solved again, more precisely."""
    return sum(face.changed > 0 for face in problem.report.faces)


@pytest.mark.ranks(2)
@every_scene
def test_no_more_changes_of_the_set_than_from_nothing(name):
    cold = problem_on(COMM, name, 2)
    cold.solve()
    assert changes_of_the_set(started(name)) <= changes_of_the_set(cold)
    np.testing.assert_allclose(normal_forces(started(name)), normal_forces(cold), rtol=1e-5)


@pytest.mark.ranks(2)
def test_coarse_mesh_may_be_on_each_rank_as_a_whole():
    name = "ball, hexahedra"
    face, expected = started(name, coarse_alone=True).report.faces[0], started(name).report.faces[0]
    assert face.active == expected.active
