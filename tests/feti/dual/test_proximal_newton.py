"""Newton's method on proximal problems finds the forces of friction from any start."""

from dataclasses import replace

import numpy as np
import pytest
from friction_problems import in_a_corner, in_a_groove, pulled_strip, pushed_block

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.dual import proximal_newton as newton_module
from fenics_tfeti.feti.dual.iterate import Iterate, SolveStatus, Turn
from fenics_tfeti.feti.dual.proximal_newton import _root, proximal_newton
from fenics_tfeti.qp import Products

pytestmark = pytest.mark.once

heavy = pytest.mark.heavy

SYSTEMS = {
    "strip": pulled_strip,
    "block": pushed_block,
    "groove": in_a_groove,
    # rows of sites in the edge depend on each other, and the active set does not settle
    "corner": lambda: in_a_corner(4),
    "small bounds": lambda: in_a_corner(12),
}


@pytest.fixture(autouse=True)
def _alone(monkeypatch):
    """Let the active set method find nothing."""
    monkeypatch.setattr(
        newton_module,
        "primal_dual_active_set",
        lambda problem, start, turn: replace(start, status=SolveStatus.STALLED),
    )


def minimum(problem, multipliers):
    """Return the cost 1/2 l'Fl - d'l."""
    return multipliers @ (0.5 * problem.F(multipliers) - problem.d)


def by_newton(solver, rtol, max_products=20_000):
    """Solve the dual problem of a solver by this method alone, from nothing."""
    problem = solver.dual_problem()
    tolerance = rtol * np.sqrt(problem.unit) * np.linalg.norm(problem.d)
    turn = Turn(tolerance, max_products, Products(), lambda step: None)
    found = proximal_newton(problem, Iterate(np.zeros_like(problem.d)), turn)
    return problem, found


@pytest.mark.parametrize("name", [
    "strip",
    "block",
    "corner",
    *(pytest.param(n, marks=heavy) for n in ("groove", "small bounds")),
])  # fmt: skip
def test_cost_is_the_smallest_for_any_bounds(name):
    solver = TornSolver(SYSTEMS[name](), Options())
    exact = solver.solve().multipliers
    problem, found = by_newton(solver, 1e-8)
    feasible = problem.multiplier_set(np.zeros_like(problem.d)).project(found.multipliers.copy())
    assert found.status is SolveStatus.SOLVED
    np.testing.assert_allclose(feasible, found.multipliers, rtol=1e-12)
    assert minimum(problem, found.multipliers) == pytest.approx(minimum(problem, exact), rel=1e-4)


def test_rows_that_are_free_without_bounds_have_no_proximal_term():
    """Multipliers of gluing and supports are those of the problem itself."""
    problem, found = by_newton(TornSolver(pulled_strip(), Options()), 1e-10)
    term = found.newton.face.proximal
    assert not term.centre[problem.constraints.equality].any()
    np.testing.assert_allclose(found.newton.gradient[problem.constraints.equality], 0.0, atol=1e-8)


def test_products_on_faces_are_no_part_of_the_turn(monkeypatch):
    """The limit grows by those that were spent there, and no more."""
    limits, solve = [], newton_module._solve_proximal

    def spend(problem, start, turn):
        turn.products.cg += 7
        return replace(start, status=SolveStatus.STALLED)

    def watch(*arguments):
        limits.append(arguments[-1].max_products)
        return solve(*arguments)

    monkeypatch.setattr(newton_module, "primal_dual_active_set", spend)
    monkeypatch.setattr(newton_module, "_solve_proximal", watch)
    by_newton(TornSolver(pulled_strip(), Options()), 1e-8, max_products=2_000)
    assert len(limits) > 1
    np.testing.assert_array_equal(np.diff(limits), 7)


@pytest.mark.parametrize(("slope", "root"), [
    (lambda t: t - 0.3, 0.3),
    (lambda t: t - 2.0, 1.0),
    (lambda t: t + 1.0, 0.0),
    (lambda t: np.sign(t - 0.3), 0.3),
])  # fmt: skip
def test_part_of_a_way_with_the_least_cost(slope, root):
    """Inside it, behind its end, before it begins, and at a kink."""
    assert _root(slope) == pytest.approx(root, abs=0.005)
