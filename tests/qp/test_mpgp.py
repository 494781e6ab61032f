"""MPGP against closed forms, an interior point method for cones, and MPRGP."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from qp_problems import Problem, random_discs, random_intervals

from fenics_tfeti.qp import Discs, Products, ProductSet, ProportioningOptions, proportioning

pytestmark = pytest.mark.once

both_expansions = pytest.mark.parametrize("expansion", ["standard", "projected_cg"])


def solve(problem: Problem, rtol: float = 1e-11, x=None, products=None, feasible=None, **options):
    """Solve to ||g^P|| <= rtol ||b|| by MPGP: the set counts as curved, with discs or without."""
    arguments = {key: options.pop(key) for key in ("precondition", "gradient") if key in options}
    options.setdefault("step_length", 1.9 / problem.norm)
    tolerance = rtol * np.linalg.norm(problem.b)
    return proportioning(
        problem.hessian,
        problem.b,
        feasible or ProductSet(problem.bounds, problem.discs),
        np.zeros_like(problem.b) if x is None else x,
        lambda split: split.gradient_norm <= tolerance,
        options=ProportioningOptions(**options),
        products=products,
        **arguments,
    )


def reduced_gradient(problem: Problem, x):
    """Return (x - P(x - a g)) / a by its definition."""
    step_length = 1.9 / problem.norm
    return (x - problem.nearest(x - step_length * (problem.A @ x - problem.b))) / step_length


@both_expansions
def test_nearest_point_of_an_ellipse_to_its_middle(expansion):
    """min 1/2 (x^2 + 4 y^2) over the unit disc around (2, 0): the point (1, 0)."""
    disc = Discs(np.array([[0, 1]]), np.array([[2.0, 0.0]]), np.ones(1))
    problem = Problem(np.diag([1.0, 4.0]), np.zeros(2), np.full(2, -np.inf), discs=disc)
    result = proportioning(
        problem.hessian, problem.b, problem.feasible, np.array([2.0, 1.0]),
        lambda split: split.gradient_norm <= 1e-13,
        options=ProportioningOptions(step_length=1.9 / 4.0, expansion=expansion),
    )  # fmt: skip
    np.testing.assert_allclose(result.x, [1.0, 0.0], atol=1e-13)


@both_expansions
@hypothesis.given(
    seed=st.integers(0, 10**6),
    discs=st.integers(1, 8),
    condition=st.sampled_from([1.0, 1e2]),
    size=st.sampled_from([1e-3, 1.0, 10.0]),
)
def test_random_problem_against_a_conic_solver(expansion, seed, discs, condition, size):
    problem = random_discs(seed, discs, condition, size)
    result = solve(problem, expansion=expansion, max_products=100_000)
    assert result.converged
    expected = problem.conic_solution()
    hypothesis.assume(expected.accurate)
    np.testing.assert_allclose(result.x, expected.x, atol=1e-8 * np.abs(expected.x).max())


@both_expansions
@hypothesis.given(seed=st.integers(0, 10**6), size=st.sampled_from([1e-3, 1.0]))
def test_optimality_by_the_projected_step(expansion, seed, size):
    problem = random_discs(seed, size=size)
    x = solve(problem, 1e-9, expansion=expansion).x
    at, centre, radius = problem.discs.indices, problem.discs.centre, problem.discs.radius
    assert np.all(problem.lower <= x)
    assert np.all(np.hypot(*(x[at] - centre).T) <= radius * (1.0 + 1e-14))
    assert np.linalg.norm(reduced_gradient(problem, x)) <= 1.1e-9 * np.linalg.norm(problem.b)


@both_expansions
@hypothesis.given(seed=st.integers(0, 10**6))
def test_without_discs_the_solution_is_that_of_mprgp(expansion, seed):
    problem = random_intervals(seed, 24)
    expected = solve(problem, feasible=problem.feasible, expansion=expansion).x
    np.testing.assert_allclose(solve(problem, expansion=expansion).x, expected, atol=1e-8)


@both_expansions
@pytest.mark.parametrize("radius", [1e-1, 1e-3, 1e-6])
def test_strong_curvature(expansion, radius):
    """The normal gradient divided by the radius is far beyond 2 / step_length.

    A step along the tangential part of the gradient would not come to rest there.
    """
    problem, products = random_discs(5, 20, 10.0, radius), Products()
    problem.lower[:] = -np.inf
    problem.b *= 10.0
    result = solve(problem, 1e-10, products=products, expansion=expansion)
    assert result.converged
    assert products.total <= 200


def test_every_kind_of_step_is_taken_and_counted():
    """Otherwise the tests of this file say nothing about some of them."""
    problem, products = random_discs(1, condition=1e3), Products()
    solve(problem, rtol=1e-6, products=products)
    assert min(products.cg, products.expansion, products.proportioning) > 0
    assert products.total == problem.calls


@both_expansions
@pytest.mark.parametrize("seed", range(2))
def test_cost_never_rises_and_iterates_are_feasible(expansion, seed):
    problem, costs = random_discs(seed, condition=1e3), []
    at, centre, radius = problem.discs.indices, problem.discs.centre, problem.discs.radius
    for limit in range(1, 40):
        x = solve(problem, expansion=expansion, max_products=limit).x
        costs.append(problem.cost(x))
        assert np.all(problem.lower <= x)
        assert np.all(np.hypot(*(x[at] - centre).T) <= radius * (1.0 + 1e-14))
    assert np.all(np.diff(costs) <= 1e-14 * np.abs(costs[-1]))


def test_known_gradient_saves_the_first_product():
    fresh, given = random_discs(3), random_discs(3)
    start = fresh.nearest(np.zeros_like(fresh.b))
    solve(fresh, x=start)
    result = solve(given, x=start, gradient=(given.A @ start - given.b, None))
    assert given.calls == fresh.calls - 1
    np.testing.assert_allclose(result.x, fresh.conic_solution().x, atol=1e-10)


def test_infeasible_start_is_projected():
    problem, start = random_discs(4), np.full(24, -5.0)
    np.testing.assert_allclose(solve(problem, x=start).x, problem.conic_solution().x, atol=1e-10)
    assert np.all(start == -5.0), "the caller's vector must not change"


@both_expansions
def test_preconditioner_changes_the_way_but_not_the_solution(expansion):
    problem, applied = random_discs(7, condition=1e3), Products()
    inverse = np.linalg.inv(problem.A)
    result = solve(
        problem, products=applied, expansion=expansion, precondition=lambda phi, _: inverse @ phi
    )
    np.testing.assert_allclose(result.x, problem.conic_solution().x, atol=1e-10)
    assert np.linalg.norm(reduced_gradient(problem, result.x)) <= 1e-10 * np.linalg.norm(problem.b)
    assert applied.preconditioner > 0


@both_expansions
@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scaling_the_unknowns_changes_nothing(expansion, scale):
    problem = random_discs(6)
    d = problem.discs
    scaled = Problem(
        problem.A,
        scale * problem.b,
        scale * problem.lower,
        discs=Discs(d.indices, scale * d.centre, scale * d.radius),
    )
    np.testing.assert_allclose(
        solve(scaled, expansion=expansion).x,
        scale * solve(problem, expansion=expansion).x,
        atol=1e-7 * scale,
    )


def test_limit_on_products():
    problem, products = random_discs(0, condition=1e4), Products()
    result = solve(problem, products=products, max_products=10)
    assert not result.converged
    assert 10 <= products.total <= 12


def test_cost_without_lower_limit_is_an_error():
    disc = Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1))
    problem = Problem(np.diag([1.0, 1.0, 0.0]), np.ones(3), np.full(3, -np.inf), discs=disc)
    with pytest.raises(ValueError, match="without limit"):
        solve(problem, step_length=1.9)


def test_bounds_alone_are_taken_too():
    problem = random_intervals(1)
    assert not problem.feasible.curved
    np.testing.assert_allclose(solve(problem).x, problem.solution(), atol=1e-8)
