"""Newton's method on proximal problems finds the forces of friction from any start."""

import numpy as np
import pytest
from friction_problems import in_a_corner, in_a_groove, pulled_strip, pushed_block

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.dual.iterate import Iterate, Method, SolveStatus, Turn
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


def minimum(problem, multipliers):
    """Return the cost 1/2 l'Fl - d'l."""
    return multipliers @ (0.5 * problem.F(multipliers) - problem.d)


def by_newton(solver, rtol, max_products=20_000):
    """Solve the dual problem of a solver by this method alone, from nothing."""
    problem = solver.dual_problem()
    tolerance = rtol * np.sqrt(problem.unit) * np.linalg.norm(problem.d)
    turn = Turn(tolerance, max_products, Products(), lambda step: None)
    found = Iterate(np.zeros_like(problem.d), status=SolveStatus.CENTRED)
    while found.status is SolveStatus.CENTRED:
        found = proximal_newton(problem, found, turn)
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
    newton = found.memory[Method.NEWTON]
    term = newton.face.proximal
    assert not term.centre[problem.constraints.equality].any()
    np.testing.assert_allclose(newton.gradient[problem.constraints.equality], 0.0, atol=1e-8)


@pytest.mark.parametrize(("slope", "root"), [
    (lambda t: t - 0.3, 0.3),
    (lambda t: t - 2.0, 1.0),
    (lambda t: t + 1.0, 0.0),
    (lambda t: np.sign(t - 0.3), 0.3),
])  # fmt: skip
def test_part_of_a_way_with_the_least_cost(slope, root):
    """Inside it, behind its end, before it begins, and at a kink."""
    assert _root(slope) == pytest.approx(root, abs=0.005)
