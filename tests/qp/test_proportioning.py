"""MPRGP and MPGP, and their steps, against closed forms and independent solvers."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
from qp_problems import Problem, random_discs, random_intervals, random_problem, string

from fenics_tfeti.qp import Discs, Products, ProductSet, ProportioningOptions, Space, proportioning
from fenics_tfeti.qp.proportioning import Proportioning

pytestmark = pytest.mark.once
both_expansions = pytest.mark.parametrize("expansion", ["standard", "projected_cg"])
# MPRGP and MPGP
both_methods = pytest.mark.parametrize("random", [random_problem, random_discs])
seeds, conditions = st.integers(0, 10**6), st.sampled_from([1.0, 1e2, 1e4])
RANDOM = {
    "half-lines": st.builds(
        random_problem, seeds, st.integers(1, 30), st.sampled_from([0.0, 0.3, 0.7, 1.0]), conditions
    ),
    "intervals": st.builds(random_intervals, seeds, st.integers(2, 30), conditions),
    "discs": st.builds(
        random_discs,
        seeds,
        st.integers(1, 8),
        st.sampled_from([1.0, 1e2]),
        st.sampled_from([1e-3, 1.0, 10.0]),
    ),
}


def solve(problem: Problem, rtol: float = 1e-12, x=None, products=None, feasible=None, **options):
    """Solve to ||g^P|| <= rtol ||b||."""
    arguments = {key: options.pop(key) for key in ("precondition", "gradient") if key in options}
    options.setdefault("step_length", 1.9 / problem.norm)
    tolerance = rtol * np.linalg.norm(problem.b)
    return proportioning(
        problem.hessian,
        problem.b,
        feasible or problem.feasible,
        np.zeros_like(problem.b) if x is None else x,
        lambda split: split.gradient_norm <= tolerance,
        options=ProportioningOptions(**options),
        products=products,
        **arguments,
    )


def assert_minimum(problem: Problem, x, rtol: float) -> None:
    """The conditions of minima, which are sufficient: the cost is strictly convex."""
    assert problem.contains(x)
    g = problem.A @ x - problem.b
    assert problem.stationarity(x, g) <= rtol * np.linalg.norm(problem.b)


@both_expansions
def test_string_over_an_obstacle(expansion):
    """In the nodes at the ends of the contact both x - l and g vanish; rounding decides."""
    problem, x, exact = string()
    found = solve(problem, expansion=expansion).x
    np.testing.assert_allclose(found, exact, atol=1e-13)
    inside, outside = (x > 0.25) & (x < 0.75), (x < 0.25) | (x > 0.75)
    assert np.all(found[inside] == problem.lower[inside])
    assert np.all(found[outside] > problem.lower[outside])


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
@pytest.mark.parametrize("kind", RANDOM)
@hypothesis.given(data=st.data())
def test_random_problem(expansion, kind, data):
    problem, rtol = data.draw(RANDOM[kind]), 1e-11 if kind == "discs" else 1e-12
    result = solve(problem, rtol, expansion=expansion, max_products=100_000)
    assert result.converged
    # the recurrence of the gradient may have drifted by a few units in its last places
    assert_minimum(problem, result.x, 1.1 * rtol)
    if kind != "discs":
        expected = problem.solution()
        np.testing.assert_allclose(result.x, expected, atol=1e-8 * max(np.abs(expected).max(), 0.1))


@both_expansions
@hypothesis.given(seeds)
def test_without_discs_the_solution_is_that_of_mprgp(expansion, seed):
    problem = random_intervals(seed, 24)
    curved = ProductSet(problem.bounds, problem.discs)
    assert curved.curved and not problem.feasible.curved
    x = solve(problem, feasible=curved, expansion=expansion).x
    np.testing.assert_allclose(x, problem.solution(), atol=1e-8)


@both_expansions
@pytest.mark.parametrize("radius", [1e-1, 1e-3, 1e-6])
def test_strong_curvature(expansion, radius):
    """The normal gradient divided by the radius is far beyond 2 / step_length.

    A step along the tangential part of the gradient would not come to rest there.
    """
    problem, products = random_discs(5, 20, 10.0, radius), Products()
    problem.lower[:] = -np.inf
    problem.b *= 10.0
    assert solve(problem, 1e-10, products=products, expansion=expansion).converged
    assert products.total <= 200


@pytest.mark.parametrize("right", [0.5, 5.0])
def test_proportioning_step_ends_at_the_opposite_bound(right):
    """From x = 0 the minimiser along the chopped gradient is 2, inside [0, 5], not [0, 0.5]."""
    problem = Problem(np.eye(1), np.array([2.0]), np.zeros(1), upper=np.array([right]))
    products = Products()
    result = solve(problem, step_length=1.0, products=products)
    assert result.x.tolist() == [min(2.0, right)]
    assert (products.cg, products.proportioning) == (1, 1)


def test_returned_gradient_and_split_belong_to_the_returned_point():
    problem = random_problem(1)
    result = solve(problem, rtol=1e-2)
    g = problem.A @ result.x - problem.b
    np.testing.assert_allclose(result.gradient, g, atol=1e-14)
    norm = problem.stationarity(result.x, g)
    assert result.split.gradient_norm == pytest.approx(norm, rel=1e-12)


@both_expansions
@both_methods
@pytest.mark.parametrize("refresh", [1, 50])
def test_products_are_the_calls_of_the_operator(expansion, random, refresh):
    """Those of several solves add up, and each kind of step is among them."""
    problem, products = random(1, condition=1e3), Products()
    for _ in range(2):
        solve(problem, 1e-6, products=products, expansion=expansion, refresh=refresh)
    assert products.total == products.cg + products.expansion + products.proportioning
    assert products.total == problem.calls
    assert min(products.cg, products.expansion, products.proportioning) > 0


@both_methods
def test_known_gradient_saves_the_first_product(random):
    fresh, given = random(3), random(3)
    start = fresh.nearest(np.zeros_like(fresh.b))
    solve(fresh, x=start)
    result = solve(given, x=start, gradient=(given.A @ start - given.b, None))
    assert given.calls == fresh.calls - 1
    assert_minimum(fresh, result.x, 1.1e-12)


@both_expansions
@both_methods
@pytest.mark.parametrize("seed", range(2))
def test_cost_never_rises_and_iterates_are_feasible(expansion, random, seed):
    problem = random(seed, condition=1e3)
    iterates = [solve(problem, expansion=expansion, max_products=limit).x for limit in range(1, 40)]
    costs = np.array([problem.cost(x) for x in iterates])
    sizes = np.abs(iterates[-1]) @ (np.abs(problem.A) @ np.abs(iterates[-1]) + np.abs(problem.b))
    assert np.all(np.diff(costs) <= np.finfo(float).eps * sizes)  # the rounding of a cost
    assert all(problem.contains(x) for x in iterates)


@pytest.mark.parametrize("distinct", [1, 2, 5])
def test_without_active_bounds_it_is_the_conjugate_gradient_method(distinct):
    """As many steps as there are distinct eigenvalues, and the product for the first gradient.

    An exact preconditioner makes it one step.
    """
    rng = np.random.default_rng(distinct)
    basis = np.linalg.qr(rng.standard_normal((20, 20)))[0]
    A = (basis * (1.0 + np.arange(20) % distinct)) @ basis.T
    problem, products = Problem(A, rng.standard_normal(20), np.full(20, -1e3)), Products()
    solve(problem, rtol=1e-11, products=products)
    assert (products.cg, products.expansion, products.proportioning) == (distinct + 1, 0, 0)
    preconditioned, inverse = Products(), np.linalg.inv(A)
    solve(problem, 1e-9, products=preconditioned, precondition=lambda phi, _: inverse @ phi)
    assert preconditioned.total == 2


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


@both_methods
def test_start(random):
    """An infeasible one is projected; from the solution nothing but its gradient is computed."""
    problem, products = random(4), Products()
    start = np.full(problem.b.size, -5.0)
    result = solve(problem, x=start)
    assert_minimum(problem, result.x, 1.1e-12)
    assert np.all(start == -5.0), "the caller's vector must not change"
    solve(problem, rtol=1e-6, x=result.x, products=products)
    assert products.total == 1


@both_expansions
@both_methods
@pytest.mark.parametrize(("cost", "length"), [(1e-20, 1.0), (1e20, 1.0), (1.0, 1e-12), (1.0, 1e12)])
def test_units_change_nothing(expansion, random, cost, length):
    """Bounds and circles are compared without an absolute tolerance."""
    problem, plain, other = random(6, condition=1e3), Products(), Products()
    d = problem.discs
    scaled = Problem(
        cost * problem.A,
        cost * length * problem.b,
        length * problem.lower,
        discs=Discs(d.indices, length * d.centre, length * d.radius),
    )
    x = solve(problem, 1e-10, products=plain, expansion=expansion).x
    found = solve(scaled, 1e-10, products=other, expansion=expansion).x
    np.testing.assert_allclose(found, length * x, atol=1e-7 * length)
    assert abs(plain.total - other.total) <= 1


@both_expansions
@both_methods
def test_limit_on_products(expansion, random):
    problem, products = random(0, condition=1e4), Products()
    assert not solve(problem, products=products, expansion=expansion, max_products=10).converged
    # A step is finished: the longest one is an expansion undone, 1 + 1 + 1 products.
    assert 10 <= products.total <= 12


@both_expansions
@both_methods
def test_preconditioner_changes_the_way_but_not_the_solution(expansion, random):
    problem = random(7, condition=1e3)
    inverse, products, applied = np.linalg.inv(problem.A), Products(), []

    def precondition(phi, _):
        applied.append(phi)
        return inverse @ phi

    result = solve(
        problem, 1e-11, products=products, expansion=expansion, precondition=precondition
    )
    assert_minimum(problem, result.x, 1.1e-11)
    assert len(applied) == products.preconditioner > 0


@pytest.mark.parametrize("seed", range(5))
def test_semidefinite_hessian_with_a_bounded_cost(seed):
    """The kernel holds no load, so the solution exists; its cost is unique, x is not."""
    problem = random_problem(seed, 12, bounded=0.5)
    values, vectors = np.linalg.eigh(problem.A)
    values[:3], problem.b = 0.0, vectors[:, 3:] @ (vectors[:, 3:].T @ problem.b)
    problem.A = (vectors * values) @ vectors.T
    assert_minimum(problem, solve(problem, rtol=1e-10).x, 1e-9)


DISC = Discs(np.array([[0, 1]]), np.zeros((1, 2)), np.ones(1))


@pytest.mark.parametrize(("diagonal", "lower", "discs"), [
    ([1.0, 0.0], [0.0, 0.0], {}),
    # where the gradient on the face is zero
    ([1.0, 0.0], [1.0, 0.0], {}),
    ([1.0, 1.0, 0.0], 3 * [-np.inf], {"discs": DISC}),
])  # fmt: skip
def test_cost_without_lower_limit_is_an_error(diagonal, lower, discs):
    problem = Problem(np.diag(diagonal), np.ones(len(diagonal)), np.array(lower), **discs)
    with pytest.raises(ValueError, match="without limit"):
        solve(problem, step_length=1.9)


def test_flat_direction_that_ends_at_a_bound_is_followed_to_it():
    problem = Problem(np.diag([1.0, 0.0]), np.array([1.0, -1.0]), np.array([0.0, -3.0]))
    np.testing.assert_allclose(solve(problem).x, [1.0, -3.0], rtol=1e-14)


def test_zero_right_hand_side():
    problem = Problem(np.eye(3), np.zeros(3), np.array([-1.0, 0.0, 2.0]))
    result = solve(problem)
    assert result.converged
    np.testing.assert_array_equal(result.x, [0.0, 0.0, 2.0])


# -- one step at a time ----------------------------------------------------------------------------


def begin(problem: Problem, x, precondition=None, **options) -> Proportioning:
    options.setdefault("step_length", 1.9 / problem.norm)
    method = Proportioning(
        problem.hessian, problem.b, problem.feasible, ProportioningOptions(**options), Space(),
        precondition, Products(),
    )  # fmt: skip
    method.start(x, None)
    return method


def test_conjugate_gradient_step_minimises_along_the_direction():
    """After a number of recurrences the gradient is recomputed."""
    problem = random_problem(0, bounded=0.0)
    method = begin(problem, np.zeros(20), refresh=2)
    g = method.g
    method.conjugate_gradient_step()
    step = g @ g / (g @ problem.A @ g)
    np.testing.assert_allclose(method.x, -step * g, rtol=1e-14)
    assert method.p is not None
    assert abs(method.p @ problem.A @ g) <= 1e-14 * np.linalg.norm(g)
    assert (method.recurrences, problem.calls) == (1, 2)
    method.conjugate_gradient_step()
    assert (method.recurrences, problem.calls) == (0, 4)
    assert method.p is None


@pytest.mark.parametrize(("expansion", "second"), [
    ("standard", 1.5 - 0.5 * (1.5 - 1.0)),
    ("projected_cg", 1.0),
])  # fmt: skip
def test_expansion_step(expansion, second):
    """From (2, 2) along (4, 1): x_1 = 0 at half of it, then x_2 - 0.5 g_2, or on along (4, 1)."""
    problem = Problem(np.eye(2), np.array([-2.0, 1.0]), np.array([0.0, -5.0]))
    method = begin(problem, np.array([2.0, 2.0]), step_length=0.5, expansion=expansion)
    method.conjugate_gradient_step()
    assert method.x.tolist() == [0.0, second]
    assert (method.products.cg, method.products.expansion) == (1, 2)


def test_projected_step_is_undone_where_the_cost_rises():
    """Along the valley x_1 = x_2 the minimiser is far outside; with x_1 = 0, x_2 is too far."""
    A = np.array([[1.0, -0.99], [-0.99, 1.0]])
    problem = Problem(A, np.array([-3.0, -2.8]), np.array([0.0, -np.inf]))
    standard = begin(problem, np.array([0.1, 0.0]))
    undone = begin(problem, np.array([0.1, 0.0]), expansion="projected_cg")
    standard.conjugate_gradient_step()
    undone.conjugate_gradient_step()
    np.testing.assert_array_equal(undone.x, standard.x)
    assert undone.products.expansion == standard.products.expansion + 1


@pytest.mark.parametrize("on_bound", [0, 3])
def test_preconditioned_gradient_vanishes_on_the_boundary(on_bound):
    problem = Problem(np.eye(4), np.arange(1.0, 5.0), np.full(4, -1.0))
    x, seen = np.zeros(4), []
    x[on_bound] = -1.0

    def precondition(phi, at):
        seen.append(at.tolist())
        return np.full(4, phi.sum())

    z = begin(problem, x, precondition).preconditioned_free_gradient()
    assert seen == [[on_bound]]
    assert np.flatnonzero(z == 0.0).tolist() == [on_bound]
