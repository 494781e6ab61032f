"""Few Newton steps a load step: pressing conditions hold with equality, contact has its Hessian."""

from itertools import pairwise
from operator import is_

import numpy as np
import pytest
from finite_strains import (
    indented_block,
    leaning_column,
    pressed_patch,
    pulled_strip,
    ring,
    squeezed_block,
)

from fenics_tfeti import Coulomb, Plane
from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.solution.linear import LinearProblem
from fenics_tfeti.newton import iteration

pytestmark = pytest.mark.once

ACCURATE = {"newton_rtol": 1e-8, "subdomain_size": 60}


def steps_of(scene, loads):
    """Return the Newton steps of each load step."""
    counts = []
    for load in loads:
        scene.solve([load])
        counts.append(scene.counts()[0])
    return counts


def test_block_under_a_plane():
    """Rubber, pressed to half of its height: as few steps as with prescribed displacements."""
    down = {"now": 0.0}

    def plane(x):
        return Plane((0.0, 1.0 - down["now"]), (0.0, -1.0))(x)

    scene, counts = indented_block(n=4, nu=0.45, obstacle=plane, **ACCURATE), []
    for down["now"] in (0.1, 0.2, 0.3, 0.4, 0.5):
        counts += steps_of(scene, [1.0])
    assert max(counts) <= 6


def test_block_that_contact_alone_holds():
    scene, _ = squeezed_block(2, 4, **ACCURATE)
    assert max(steps_of(scene, np.linspace(0.25, 1.0, 4))) <= 5


@pytest.mark.parametrize("size", [20, pytest.param(60, marks=pytest.mark.heavy), 3000])
def test_steps_do_not_depend_on_the_partition(size):
    """Of a pair, whose forces turn and move with both surfaces."""
    scene, _ = pressed_patch(0.4, False, newton_rtol=1e-8, subdomain_size=size)
    assert max(steps_of(scene, [0.5, 1.0])) <= 6


def test_forces_that_turn():
    """In three dimensions friction has two directions."""
    scene, _ = pressed_patch(
        0.1, False, cell="hexahedron", motion=20.0, friction=Coulomb(0.05), **ACCURATE
    )
    assert max(steps_of(scene, [0.5, 1.0])) <= 8


@pytest.mark.parametrize("loads", [[1.0], pytest.param([0.5, 1.0], marks=pytest.mark.heavy)])
def test_unstable_equilibria_are_left(loads):
    """A column under a plane buckles; the straight one, with a tip that moves by 0.02, is a saddle.

    The energy of the buckled one is less than a tenth of that.
    """
    scene = leaning_column()
    assert max(steps_of(scene, loads)) <= 15
    tip = scene.problem.u.x.array.reshape(-1, 2)[:, 0].max()
    assert tip == pytest.approx(0.4422, abs=1e-3)
    assert scene.problem.results[0].force[1] == pytest.approx(-3.495e-4, rel=1e-3)


def test_slip_that_spreads():
    """From the pulled end of a strip over 9 of 48 nodes: not in a Newton step for each of them."""
    scene = pulled_strip(48, Coulomb(0.3))
    assert max(steps_of(scene, [1.0, 1.5, 2.0])) <= 4
    assert np.count_nonzero(scene.problem.results[0].friction.state == 2) >= 9


@pytest.fixture
def set_ups(monkeypatch):
    """The stiffness matrices of each set-up."""
    made = []

    class Counted(iteration.TornSolver):
        def __init__(self, system, *args):
            made.append([subdomain.stiffness for subdomain in system.subdomains])
            super().__init__(system, *args)

    monkeypatch.setattr(iteration, "TornSolver", Counted)
    return made


@pytest.mark.parametrize("size", [20, 3000])
def test_one_set_up_while_the_same_conditions_hold(set_ups, size):
    """Later steps take it again, whatever tangents it has."""
    scene, _ = pressed_patch(0.2, False, newton_rtol=1e-8, subdomain_size=size)
    # at first nothing is pressed
    assert steps_of(scene, [0.5]) > [2]
    assert len(set_ups) <= 2
    set_ups.clear()
    assert steps_of(scene, [1.0]) > [2]
    assert len(set_ups) == 1


def test_rows_that_leave_a_face_keep_the_factors(set_ups):
    """A cylinder is lifted: nodes at the rim of contact would pull."""
    scene = indented_block(n=8, nu=0.3, subdomain_size=60)
    scene.solve([1.0])
    set_ups.clear()
    scene.solve([0.5])
    again = [all(map(is_, *pair)) for pair in pairwise(set_ups)]
    assert any(again)


def test_products_of_solutions_that_are_not_taken_count(monkeypatch):
    """Those of set-ups of earlier steps that do not serve, and of rows that would pull."""
    spent = []

    def counted(function, products):
        def call(*args, **more):
            solution = function(*args, **more)
            spent.append(products(solution))
            return solution

        return call

    approximate = counted(LinearProblem.approximate, lambda solution: solution.products)
    monkeypatch.setattr(LinearProblem, "approximate", approximate)
    solve = counted(TornSolver.solve, lambda solution: solution.report.products["total"])
    monkeypatch.setattr(TornSolver, "solve", solve)
    scene = ring(0.1, 48, 3, degree=1, subdomain_size=100)
    scene.solve([1.0])
    assert sum(step.products for step in scene.problem.report.newton) == sum(spent)


def test_nodes_without_an_obstacle_have_no_gap_to_compare():
    """Nothing is computed with their infinite gaps."""

    def half_a_plane(x):
        gap, normal = Plane((0.0, 0.95), (0.0, -1.0))(x)
        return np.where(x[0] < 0.3, gap, np.inf), normal

    scene = indented_block(n=4, obstacle=half_a_plane)
    with np.errstate(invalid="raise"):
        scene.solve([1.0])
    assert sum(step.corrections for step in scene.problem.report.newton) > 0
