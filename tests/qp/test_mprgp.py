"""MPRGP against closed forms and an independent solver."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from qp_problems import Problem, random_intervals, random_problem, string

from fenics_tfeti.qp import Products, ProductSet, ProportioningOptions, proportioning

pytestmark = pytest.mark.once

both_expansions = pytest.mark.parametrize("expansion", ["standard", "projected_cg"])


def solve(problem: Problem, rtol: float = 1e-12, x=None, products=None, **options):
    """Solve to ||g^P|| <= rtol ||b||."""
    arguments = {key: options.pop(key) for key in ("precondition", "gradient") if key in options}
    options.setdefault("step_length", 1.9 / problem.norm)
    tolerance = rtol * np.linalg.norm(problem.b)
    return proportioning(
        problem.hessian,
        problem.b,
        ProductSet(problem.bounds),
        np.zeros_like(problem.b) if x is None else x,
        lambda split: split.gradient_norm <= tolerance,
        options=ProportioningOptions(**options),
        products=products,
        **arguments,
    )


@both_expansions
def test_string_over_an_obstacle(expansion):
    problem, _, exact = string()
    np.testing.assert_allclose(solve(problem, expansion=expansion).x, exact, atol=1e-13)


@both_expansions
def test_resting_part_of_the_string_is_exactly_on_the_obstacle(expansion):
    """In the nodes at the ends of the contact both x - l and g vanish; rounding decides."""
    problem, x, _ = string()
    found = solve(problem, expansion=expansion).x
    inside, outside = (x > 0.25) & (x < 0.75), (x < 0.25) | (x > 0.75)
    assert np.all(found[inside] == problem.lower[inside])
    assert np.all(found[outside] > problem.lower[outside])


@both_expansions
@hypothesis.given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 30),
    bounded=st.sampled_from([0.0, 0.3, 0.7, 1.0]),
    condition=st.sampled_from([1.0, 1e2, 1e4]),
)
def test_random_problem_against_quadprog(expansion, seed, n, bounded, condition):
    problem = random_problem(seed, n, bounded, condition)
    result = solve(problem, expansion=expansion)
    assert result.converged
    expected = problem.solution()
    np.testing.assert_allclose(result.x, expected, atol=1e-8 * np.abs(expected).max())


@both_expansions
@hypothesis.given(
    seed=st.integers(0, 10**6), n=st.integers(2, 30), condition=st.sampled_from([1.0, 1e2, 1e4])
)
def test_random_intervals_against_quadprog(expansion, seed, n, condition):
    problem = random_intervals(seed, n, condition)
    result = solve(problem, expansion=expansion)
    assert result.converged
    assert np.all((problem.lower <= result.x) & (result.x <= problem.upper))
    expected = problem.solution()
    np.testing.assert_allclose(result.x, expected, atol=1e-8 * max(np.abs(expected).max(), 0.1))
    gradient = problem.projected_gradient(result.x, problem.A @ result.x - problem.b)
    assert np.linalg.norm(gradient) <= 1.1e-12 * np.linalg.norm(problem.b)


@pytest.mark.parametrize("right", [0.5, 5.0])
def test_proportioning_step_ends_at_the_opposite_bound(right):
    """From x = 0 the minimiser along the chopped gradient is 2, inside [0, 5], not [0, 0.5]."""
    problem = Problem(np.eye(1), np.array([2.0]), np.zeros(1), upper=np.array([right]))
    products = Products()
    result = solve(problem, step_length=1.0, products=products)
    assert result.x.tolist() == [min(2.0, right)]
    assert (products.cg, products.proportioning) == (1, 1)


@both_expansions
@hypothesis.given(seed=st.integers(0, 10**6), n=st.integers(1, 30))
def test_kkt_conditions(expansion, seed, n):
    problem = random_problem(seed, n)
    x = solve(problem, rtol=1e-9, expansion=expansion).x
    gradient = problem.projected_gradient(x, problem.A @ x - problem.b)
    assert np.all(x >= problem.lower)
    # The recurrence of the gradient may have drifted by a few units in its last places.
    assert np.linalg.norm(gradient) <= 1.1e-9 * np.linalg.norm(problem.b)


def test_returned_gradient_and_split_belong_to_the_returned_point():
    problem = random_problem(1)
    result = solve(problem, rtol=1e-2)
    gradient = problem.A @ result.x - problem.b
    np.testing.assert_allclose(result.gradient, gradient, atol=1e-14)
    projected = problem.projected_gradient(result.x, gradient)
    np.testing.assert_allclose(result.split.gradient_norm, np.linalg.norm(projected), rtol=1e-12)


@both_expansions
@pytest.mark.parametrize("refresh", [1, 50])
def test_products_are_the_calls_of_the_operator(expansion, refresh):
    """Those of several solves add up, and each kind of step is among them."""
    problem, products = random_problem(2, 30, condition=1e3), Products()
    for _ in range(2):
        solve(problem, products=products, expansion=expansion, refresh=refresh)
    assert products.total == products.cg + products.expansion + products.proportioning
    assert products.total == problem.calls
    assert min(products.cg, products.expansion, products.proportioning) > 0


def test_known_gradient_saves_the_first_product():
    fresh, given = random_problem(3), random_problem(3)
    solve(fresh)
    result = solve(given, gradient=(-given.b, None))
    assert given.calls == fresh.calls - 1
    np.testing.assert_allclose(result.x, fresh.solution(), atol=1e-10)


@both_expansions
@pytest.mark.parametrize("seed", range(2))
def test_cost_never_rises_and_iterates_are_feasible(expansion, seed):
    problem = random_problem(seed, 30, condition=1e3)
    iterates = [solve(problem, expansion=expansion, max_products=limit).x for limit in range(1, 60)]
    costs = np.array([problem.cost(x) for x in iterates])
    assert np.all(np.diff(costs) <= 1e-14 * np.abs(costs[-1]))
    assert np.all(iterates >= problem.lower)


@pytest.mark.parametrize("distinct", [1, 2, 5])
def test_without_active_bounds_it_is_the_conjugate_gradient_method(distinct):
    """As many steps as there are distinct eigenvalues, and the product for the first gradient."""
    rng = np.random.default_rng(distinct)
    basis = np.linalg.qr(rng.standard_normal((20, 20)))[0]
    A = (basis * (1.0 + np.arange(20) % distinct)) @ basis.T
    problem, products = Problem(A, rng.standard_normal(20), np.full(20, -1e3)), Products()
    solve(problem, rtol=1e-11, products=products)
    assert (products.cg, products.expansion, products.proportioning) == (distinct + 1, 0, 0)


@both_expansions
@pytest.mark.parametrize("seed", range(5))
def test_finite_termination(expansion, seed):
    """The active set is found in finitely many steps; then conjugate gradients need at most n."""
    n = 12
    problem = random_problem(seed, n, condition=10.0)
    at_1e6, at_1e12 = Products(), Products()
    solve(problem, rtol=1e-6, products=at_1e6, expansion=expansion)
    solve(problem, rtol=1e-12, products=at_1e12, expansion=expansion)
    assert at_1e12.total - at_1e6.total <= n


def test_infeasible_start_is_projected():
    problem = random_problem(4, bounded=1.0)
    start = np.full(20, -5.0)
    result = solve(problem, x=start)
    np.testing.assert_allclose(result.x, problem.solution(), atol=1e-10)
    assert np.all(start == -5.0), "the caller's vector must not change"


def test_start_at_the_solution_takes_one_product():
    problem, products = random_problem(5), Products()
    solve(problem, rtol=1e-6, x=solve(problem).x, products=products)
    assert products.total == 1


@both_expansions
@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scaling_the_cost_changes_nothing(expansion, scale):
    problem = random_problem(6, condition=1e3)
    scaled = Problem(scale * problem.A, scale * problem.b, problem.lower)
    plain, other = Products(), Products()
    x = solve(problem, rtol=1e-8, products=plain, expansion=expansion).x
    np.testing.assert_allclose(
        solve(scaled, rtol=1e-8, products=other, expansion=expansion).x, x, atol=1e-7
    )
    assert abs(plain.total - other.total) <= 1


@both_expansions
@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_scaling_the_unknowns_changes_nothing(expansion, scale):
    """Bounds are compared without an absolute tolerance."""
    problem = random_problem(6, condition=1e3)
    scaled = Problem(problem.A, scale * problem.b, scale * problem.lower)
    np.testing.assert_allclose(
        solve(scaled, rtol=1e-10, expansion=expansion).x,
        scale * solve(problem, rtol=1e-10, expansion=expansion).x,
        atol=1e-7 * scale,
    )


@both_expansions
def test_limit_on_products(expansion):
    problem, products = random_problem(0, 30, condition=1e4), Products()
    result = solve(problem, products=products, expansion=expansion, max_products=10)
    assert not result.converged
    # A step is finished: the longest one is an expansion undone, 1 + 1 + 1 products.
    assert 10 <= products.total <= 12


@both_expansions
def test_preconditioner_changes_the_way_but_not_the_solution(expansion):
    problem = random_problem(7, 30, condition=1e4)
    inverse = np.linalg.inv(problem.A)
    plain, preconditioned, applied = Products(), Products(), []

    def precondition(phi, _):
        applied.append(phi)
        return inverse @ phi

    solve(problem, rtol=1e-10, products=plain, expansion=expansion)
    result = solve(
        problem, 1e-10, products=preconditioned, expansion=expansion, precondition=precondition
    )
    np.testing.assert_allclose(result.x, problem.solution(), atol=1e-7)
    assert len(applied) == preconditioned.preconditioner
    assert plain.preconditioner == 0


def test_exact_preconditioner_without_active_bounds_takes_one_step():
    problem, products = random_problem(8, bounded=0.0, condition=1e4), Products()
    inverse = np.linalg.inv(problem.A)
    solve(problem, rtol=1e-9, products=products, precondition=lambda phi, _: inverse @ phi)
    assert products.total == 2


@pytest.mark.parametrize("seed", range(5))
def test_semidefinite_hessian_with_a_bounded_cost(seed):
    """The kernel holds no load, so the solution exists; its cost is unique, x is not."""
    problem = random_problem(seed, 12, bounded=0.5)
    values, vectors = np.linalg.eigh(problem.A)
    values[:3], problem.b = 0.0, vectors[:, 3:] @ (vectors[:, 3:].T @ problem.b)
    problem.A = (vectors * values) @ vectors.T
    x = solve(problem, rtol=1e-10).x
    gradient = problem.projected_gradient(x, problem.A @ x - problem.b)
    assert np.linalg.norm(gradient) <= 1e-9 * np.linalg.norm(problem.b)


def test_cost_without_lower_limit_is_an_error():
    problem = Problem(np.diag([1.0, 0.0]), np.array([1.0, 1.0]), np.array([0.0, 0.0]))
    with pytest.raises(ValueError, match="without limit"):
        solve(problem)


def test_flat_direction_that_ends_at_a_bound_is_followed_to_it():
    problem = Problem(np.diag([1.0, 0.0]), np.array([1.0, -1.0]), np.array([0.0, -3.0]))
    np.testing.assert_allclose(solve(problem).x, [1.0, -3.0], rtol=1e-14)


def test_zero_right_hand_side():
    problem = Problem(np.eye(3), np.zeros(3), np.array([-1.0, 0.0, 2.0]))
    result = solve(problem)
    assert result.converged
    np.testing.assert_array_equal(result.x, [0.0, 0.0, 2.0])
