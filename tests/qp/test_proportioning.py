"""The steps that MPRGP and MPGP have in common, one at a time."""

from __future__ import annotations

import numpy as np
import pytest
from qp_problems import Problem, random_problem

from fenics_tfeti.qp import Products, ProportioningOptions, Space
from fenics_tfeti.qp.proportioning import Proportioning

pytestmark = pytest.mark.once


def begin(problem: Problem, x, precondition=None, **options) -> Proportioning:
    options.setdefault("step_length", 1.9 / problem.norm)
    method = Proportioning(
        problem.hessian, problem.b, problem.feasible, ProportioningOptions(**options), Space(),
        precondition, Products(),
    )  # fmt: skip
    method.start(x, None)
    return method


def test_conjugate_gradient_step_minimises_along_the_direction():
    problem = random_problem(0, bounded=0.0)
    method = begin(problem, np.zeros(20))
    g = method.g
    method.conjugate_gradient_step()
    step = g @ g / (g @ problem.A @ g)
    np.testing.assert_allclose(method.x, -step * g, rtol=1e-14)
    assert method.p is not None
    assert abs(method.p @ problem.A @ g) <= 1e-14 * np.linalg.norm(g)


def test_expansion_step_goes_to_the_bound_and_on_with_the_fixed_length():
    """From (2, 2) along (4, 1): x_1 = 0 at half of it, then x_2 - 0.5 g_2."""
    problem = Problem(np.eye(2), np.array([-2.0, 1.0]), np.array([0.0, -5.0]))
    method = begin(problem, np.array([2.0, 2.0]), step_length=0.5)
    method.conjugate_gradient_step()
    assert method.x.tolist() == [0.0, 1.5 - 0.5 * (1.5 - 1.0)]
    assert (method.products.cg, method.products.expansion) == (1, 2)


def test_projected_conjugate_gradient_step_takes_one_product_less():
    problem = Problem(np.eye(2), np.array([-2.0, 1.0]), np.array([0.0, -5.0]))
    method = begin(problem, np.array([2.0, 2.0]), step_length=0.5, expansion="projected_cg")
    method.conjugate_gradient_step()
    assert method.x.tolist() == [0.0, 1.0]
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


def test_gradient_is_recomputed_after_a_number_of_recurrences():
    problem = random_problem(1, bounded=0.0)
    method = begin(problem, np.zeros(20), refresh=2)
    method.conjugate_gradient_step()
    assert (method.recurrences, problem.calls) == (1, 2)
    method.conjugate_gradient_step()
    assert (method.recurrences, problem.calls) == (0, 4)
    assert method.p is None


@pytest.mark.parametrize("on_bound", [0, 3])
def test_preconditioned_gradient_vanishes_on_the_boundary(on_bound):
    problem = Problem(np.eye(4), np.arange(1.0, 5.0), np.full(4, -1.0))
    x = np.zeros(4)
    x[on_bound] = -1.0
    seen = []

    def precondition(phi, at):
        seen.append(at.tolist())
        return np.full(4, phi.sum())

    method = begin(problem, x, precondition)
    z = method.preconditioned_free_gradient()
    assert seen == [[on_bound]]
    assert z[on_bound] == 0.0
    assert np.count_nonzero(z) == 3
