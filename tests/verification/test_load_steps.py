"""A problem solved again after a change gives what a new problem gives, and reuses what it can."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import SIDE_X
from stepped_blocks import CHANGES, new_problem, nothing, two_blocks_on_a_floor

from fenics_tfeti import InputError, Plane, RigidObstacle

every_change = pytest.mark.parametrize("change", CHANGES)


def assert_same(problem, uh, other, expected):
    np.testing.assert_allclose(
        uh.x.array, expected.x.array, atol=1e-7 * np.abs(expected.x.array).max()
    )
    assert len(problem.contact) == len(other.contact)
    for mine, theirs in zip(problem.contact, other.contact, strict=True):
        assert mine.name == theirs.name
        for name in ("nodes", "gap", "normal"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        np.testing.assert_allclose(
            mine.normal_force, theirs.normal_force, atol=1e-6 * theirs.normal_force.max()
        )
    np.testing.assert_allclose(
        problem.report.contact_force, other.report.contact_force, rtol=1e-7, atol=1e-3
    )
    assert problem.report.pairing == other.report.pairing


@every_change
def test_solved_again_is_solved_anew(change):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    before = problem.solve()
    reused = change(scene)
    problem.contacts = list(scene.contacts)
    uh = problem.solve()
    other = new_problem(scene)
    assert_same(problem, uh, other, other.solve())
    assert other.report.reused == []
    assert problem.report.reused == reused
    moved = np.abs(uh.x.array - before.x.array).max() / np.abs(uh.x.array).max()
    assert (moved > 1e-2) == (change is not nothing)


@every_change
def test_changes_before_the_first_solve(change):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    change(scene)
    problem.contacts = list(scene.contacts)
    uh = problem.solve()
    other = new_problem(scene)
    assert_same(problem, uh, other, other.solve())


def test_there_and_back():
    """Without friction there is no history."""
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    first = problem.solve()
    for factor in (1.5, 0.2, 1.0):
        scene.load.value = factor * -2e7
        last = problem.solve()
    np.testing.assert_allclose(last.x.array, first.x.array, atol=1e-7 * np.abs(first.x.array).max())


def test_results_of_earlier_steps_stay():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    first, contact, report = problem.solve(), problem.contact, problem.report
    u, force = first.x.array.copy(), contact[0].normal_force.copy()
    scene.load.value *= 2.0
    problem.solve()
    np.testing.assert_array_equal(first.x.array, u)
    np.testing.assert_array_equal(contact[0].normal_force, force)
    assert report.reused == []


def test_warm_start_costs_at_most_half():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    problem.solve()
    scene.load.value *= 1.1
    problem.solve()
    other = new_problem(scene)
    other.solve()
    assert problem.report.products["total"] <= 0.5 * other.report.products["total"]


def test_seconds_and_products_are_those_of_the_step():
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    problem.solve()
    assert problem.report.products["norm"] > 0
    problem.solve()
    report = problem.report
    assert report.products["norm"] == 0
    assert "partition" not in report.seconds and "compilation" not in report.seconds
    assert report.seconds["factorisation"] < 0.01


@pytest.mark.parametrize("what", ["load", "young", "shift"])
def test_nan_is_noticed_and_forgiven(what):
    scene = two_blocks_on_a_floor()
    problem = new_problem(scene)
    before = problem.solve().x.array
    constant = getattr(scene, what)
    right = float(constant.value)
    constant.value = np.nan
    with pytest.raises(InputError, match="NaN"):
        problem.solve()
    constant.value = right
    np.testing.assert_allclose(problem.solve().x.array, before, atol=1e-7 * np.abs(before).max())


def test_contact_added():
    scene = two_blocks_on_a_floor()
    wall = RigidObstacle(scene.tags, SIDE_X, Plane((1e-4, 0), (1, 0)), name="wall")
    scene.bcs = scene.bcs[:1]  # the lower block's left side
    scene.contacts.append(RigidObstacle(scene.tags, SIDE_X, Plane((0, 0), (1, 0)), name="guide"))
    problem = new_problem(scene)
    with_guide = problem.solve()
    scene.contacts[2] = wall
    problem.contacts = list(scene.contacts)
    assert not np.allclose(problem.solve().x.array, with_guide.x.array, atol=1e-6)
