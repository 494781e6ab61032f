"""SMALBE-M against an independent solver and the KKT conditions."""

from __future__ import annotations

from dataclasses import replace

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import quadprog
from pairwise import pairwise
from qp_problems import Problem, membranes, random_discs, random_intervals, random_problem

from fenics_tfeti.qp import (
    Bounds,
    Products,
    ProductSet,
    ProportioningOptions,
    SMALBEOptions,
    smalbe,
)
from fenics_tfeti.qp.smalbe import SMALBEState

pytestmark = pytest.mark.once

both_expansions = pytest.mark.parametrize("expansion", ["standard", "projected_cg"])
# below it rows of G are so nearly dependent on the face that multipliers take thousands of steps
INDEPENDENT = 0.1


def projected(problem: Problem) -> Problem:
    """Return the problem with PAP and Pb, which is the same where Gx = o."""
    P = np.eye(problem.b.size) - problem.G.T @ problem.G
    A = P @ problem.A @ P
    return replace(problem, A=0.5 * (A + A.T), b=P @ problem.b, calls=0)


def augmented_gradient(problem: Problem, result):
    """Return the gradient that the stopping test is about, by its definition."""
    x, q = result.state.x, result.state.q
    return problem.A @ x - problem.b + q + problem.norm * problem.G.T @ (problem.G @ x)


def solve(problem: Problem, rtol: float = 1e-9, start=None, products=None, monitor=None, **options):
    """Solve with the penalty at the norm of the Hessian, as the method is meant to be used."""
    inner = {
        key: options.pop(key) for key in ("expansion", "max_products", "refresh") if key in options
    }
    options = {"rho": problem.norm, "max_it": 5000, "patience": 5000, **options}
    inner.setdefault("max_products", 100_000)
    step_length = 1.9 / np.linalg.norm(problem.A + options["rho"] * problem.G.T @ problem.G, 2)
    zeros = np.zeros_like(problem.b)
    return smalbe(
        problem.penalised(options["rho"]),
        problem.b,
        problem.feasible,
        SMALBEState(zeros, zeros) if start is None else start,
        options=SMALBEOptions(
            rtol=rtol, inner=ProportioningOptions(step_length=step_length, **inner), **options
        ),
        products=products,
        monitor=monitor,
    )


seeds, equalities = st.integers(0, 10**6), st.integers(1, 5)
RANDOM = {
    "half-lines": st.builds(
        random_problem,
        seeds,
        st.integers(15, 30),
        st.sampled_from([0.0, 0.3, 0.7, 1.0]),
        st.sampled_from([1.0, 1e2]),
        equalities,
    ),
    "intervals": st.builds(random_intervals, seeds, equalities=equalities),
    "discs": st.builds(random_discs, seeds, equalities=equalities),
}


@both_expansions
@pytest.mark.parametrize("kind", RANDOM)
@hypothesis.given(data=st.data(), project=st.booleans())
def test_random_problem(expansion, kind, data, project):
    original, rtol = data.draw(RANDOM[kind]), 1e-9
    problem = projected(original) if project else original
    if kind != "discs":
        expected = original.solution()
        hypothesis.assume(original.independence(expected) > INDEPENDENT)
    result = solve(problem, rtol, expansion=expansion)
    x, q, scale = result.state.x, result.state.q, np.linalg.norm(problem.b)
    hypothesis.assume(original.independence(x) > INDEPENDENT)
    assert result.converged
    # the KKT conditions, which are sufficient, with q = G'mu for some mu
    assert problem.contains(x)
    assert np.linalg.norm(problem.G @ x) <= 1.01 * rtol * scale
    np.testing.assert_allclose(problem.G.T @ (problem.G @ q), q, atol=1e-12 * scale)
    gradient = augmented_gradient(problem, result)
    assert problem.stationarity(x, gradient) <= 1.01 * rtol * scale
    if kind != "discs":
        np.testing.assert_allclose(x, expected, atol=1e-6 * max(1.0, abs(expected).max()))


def test_balance_is_updated_where_the_lagrangian_is_rounding():
    """With M > rho, mu is updated twice for one x, and Gx only changes its sign until M is less."""
    problem = projected(random_problem(48079, 16, 0.0, 100.0, 5))
    result = solve(problem, rtol=1e-9)
    assert result.converged
    assert len(result.history) <= 5


@both_expansions
@pytest.mark.parametrize("seed", range(2))
def test_history(expansion, seed):
    """It counts the products, and its last line is what the stopping test saw."""
    problem, rtol = random_problem(seed, 30, equalities=4, condition=1e3), 1e-7
    products, lines = Products(), []
    result = solve(problem, rtol, products=products, monitor=lines.append, expansion=expansion)
    np.testing.assert_allclose(result.gradient, augmented_gradient(problem, result), atol=1e-13)
    assert lines == result.history
    assert [line.number for line in lines] == list(range(len(lines)))
    assert lines[-1].products == products.total == problem.calls
    assert np.all(np.diff([line.products for line in lines]) >= 0)
    last, scale = lines[-1], np.linalg.norm(problem.b)
    assert max(last.gradient, last.constraint) <= rtol
    violation = np.linalg.norm(problem.G @ result.state.x) / scale
    assert last.constraint == pytest.approx(violation, rel=1e-6)
    assert last.active == np.count_nonzero(result.state.x == problem.lower)


def test_an_outer_iteration_costs_no_product():
    """With A = I and mu = o each inner solve is one step: its product is all there is."""
    problem = Problem(np.eye(4), np.arange(4.0), np.full(4, -np.inf), np.eye(4)[:1])
    result = solve(problem, rtol=1e-12)
    assert problem.calls == result.history[-1].products
    assert problem.calls <= len(result.history)


def test_balance_falls_by_its_factor_or_stays():
    problem = random_problem(0, 30, condition=1e3, equalities=4)
    result = solve(problem, rtol=1e-10, M0=1e4, beta=0.25)
    balances = np.array([line.M for line in result.history])
    ratios = balances[1:] / balances[:-1]
    assert result.history[0].M == 1e4
    assert set(ratios) == {1.0, 0.25}


@pytest.mark.parametrize(("M0", "penalty"), [(1e-2, 0.1), (1.0, 10.0), (1e4, 0.1), (1e4, 10.0)])
def test_parameters_change_the_way_but_not_the_solution(M0, penalty):
    problem = random_problem(3, 20, equalities=3)
    result = solve(problem, rho=penalty * problem.norm, M0=M0, max_it=1000)
    np.testing.assert_allclose(result.state.x, problem.solution(), atol=1e-6)


@both_expansions
def test_going_on_from_the_last_state(expansion):
    problem = random_problem(4, equalities=3)
    first = solve(problem, rtol=1e-6, expansion=expansion)
    products = Products()
    again = solve(problem, rtol=1e-6, start=first.state, products=products, expansion=expansion)
    assert products.total == 1, "the gradient at the start is all that is needed"
    assert len(again.history) == 1
    x, q = first.state.x.copy(), first.state.q.copy()
    further = solve(problem, rtol=1e-10, start=first.state, expansion=expansion)
    assert np.all(first.state.x == x) and np.all(first.state.q == q), "the start must not change"
    np.testing.assert_allclose(further.state.x, problem.solution(), atol=1e-7)


def test_limits():
    """On outer iterations, and on the products of all inner solves together."""
    result = solve(random_problem(5, equalities=3), max_it=2)
    assert not result.converged and "max_it" in result.reason
    assert len(result.history) == 2
    problem = random_problem(5, 30, condition=1e4, equalities=3)
    result = solve(problem, max_products=15)
    assert not result.converged and "max_products" in result.reason
    assert 15 <= problem.calls <= 17


def test_no_constraint_violated_needs_no_multiplier():
    """Where the free minimiser satisfies the equalities, they change nothing."""
    problem = random_problem(6, bounded=0.0, equalities=3)
    x = problem.G.T @ np.zeros(3) + projected(problem).b
    problem.b = problem.A @ x
    result = solve(problem, rtol=1e-10)
    np.testing.assert_allclose(result.state.x, x, atol=1e-8)


# -- a dual that another code computed -------------------------------------------------------------


@pytest.fixture(scope="module")
def dual():
    return membranes()


@pytest.fixture(scope="module")
def minimum(dual) -> float:
    """The exact minimum, by quadprog on the complement of the kernel."""
    values, vectors = np.linalg.eigh(dual.A + dual.G.T @ dual.G)
    V = vectors[:, values > 1e-10 * values[-1]]
    bounded = np.isfinite(dual.lower)
    GV = dual.G @ V
    y = quadprog.solve_qp(
        V.T @ dual.A @ V + GV.T @ GV,
        V.T @ dual.b,
        np.vstack([GV, V[bounded]]).T,
        np.concatenate([np.zeros(len(GV)), dual.lower[bounded]]),
        len(GV),
    )[0]
    return dual.cost(V @ y)


ERRORS = {1e-5: 2e-2, 1e-8: 2e-5, 1e-12: 1e-7}


@pytest.mark.parametrize(
    ("rtol", "project", "expansion"), pairwise(ERRORS, [False, True], ["standard", "projected_cg"])
)
def test_membranes(dual, minimum, project, rtol, expansion):
    """The cost is 1/400 of its terms, so 1e-5 in the gradient leaves 1 % in the cost."""
    problem = projected(dual) if project else dual
    result = solve(problem, rtol, expansion=expansion)
    assert result.converged
    assert dual.cost(result.state.x) == pytest.approx(minimum, rel=ERRORS[rtol])


def test_patience_ends_where_the_constraint_does_not_decrease():
    """With x_1 at its bound, x_1 + 1e-4 x_2 = 0 needs mu = 1e4, and mu grows by 1e-4 each time."""
    G = np.array([[1.0, 1e-4]]) / np.hypot(1.0, 1e-4)
    Q = G.T @ G
    P = np.identity(2) - Q
    b = P @ np.array([0.0, 1.0])
    result = smalbe(
        lambda x: (P @ x + Q @ x, Q @ x),
        b,
        ProductSet(Bounds.from_below(np.array([0]), np.zeros(1))),
        SMALBEState(np.zeros(2), np.zeros(2)),
        options=SMALBEOptions(
            rtol=1e-9, patience=5, inner=ProportioningOptions(step_length=1.9, max_products=1000)
        ),
    )
    assert result.reason == "slow"
    assert not result.converged
    assert len(result.history) < 100
