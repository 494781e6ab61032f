from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import nnls
from torn import column

from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)

# Curtis, Han, Robinson, Comput. Optim. Appl. 60 (2015), example 1: active sets that repeat
CYCLING = np.array([[4.0, 5.0, -5.0], [5.0, 9.0, -5.0], [-5.0, -5.0, 7.0]])
LOAD = np.array([2.0, 1.0, -3.0])


def springs(F: np.ndarray, d: np.ndarray) -> TornSystem:
    """Return a system in the plane whose dual problem is min 1/2 l'Fl - d'l, l >= o.

    Its nodes are on springs in x; in y they are coupled by F^{-1}.
    """
    k = len(F)
    K = np.kron(np.eye(k), np.diag([1.0, 0.0])) + np.kron(np.linalg.inv(F), np.diag([0.0, 1.0]))
    points = np.column_stack([np.arange(k), np.arange(k) ** 2])
    numbers = np.arange(k)
    force = np.column_stack([np.zeros(k), np.linalg.solve(F, d)]).ravel()
    block = Subdomain(sp.csr_matrix(K), force, points.astype(float), numbers, 0)
    up, none = np.tile([0.0, 1.0], (k, 1)), np.full(k, -1)
    return TornSystem(
        [block], Prescribed(), ContactRows(numbers, none, up, np.zeros(k), 0 * numbers), 2
    )


def faces(solver: TornSolver) -> list[int]:
    return [step.changed for step in solver.solve().report.faces]


@pytest.mark.parametrize("precision", ["double", "single"])
def test_cycle_is_left_to_smalbe(precision):
    """The sets repeat: the unsafeguarded loop would not end. The solution comes all the same."""
    options = Options(rtol=1e-10, dual_operator="explicit", operator_precision=precision)
    solution = TornSolver(springs(CYCLING, LOAD), options).solve()
    factor = np.linalg.cholesky(CYCLING).T
    exact = nnls(factor, np.linalg.solve(factor.T, LOAD))[0]
    assert solution.report.faces[-1].changed > 0
    assert solution.report.converged
    np.testing.assert_allclose(solution.normal_force, exact, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_random_quadratic_programme(seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((8, 8))
    F, d = A @ A.T + 0.1 * np.eye(8), rng.standard_normal(8)
    factor = np.linalg.cholesky(F).T
    exact = nnls(factor, np.linalg.solve(factor.T, d))[0]
    force = TornSolver(springs(F, d), Options(rtol=1e-10)).solve().normal_force
    np.testing.assert_allclose(force, exact, atol=1e-7)


@pytest.mark.parametrize("preconditioner", ["none", "lumped", "dirichlet"])
def test_set_that_stays_ends_the_loop_and_the_certificate_confirms(preconditioner):
    report = TornSolver(column(), Options(preconditioner=preconditioner)).solve().report
    assert report.outer_iterations == 0
    assert report.certificate.worst <= 1e-6


def test_limit_of_products_holds_here_too():
    options = Options(max_products=5, error_if_not_converged=False)
    report = TornSolver(column(), options).solve().report
    assert not report.converged
    assert report.products["total"] <= 5 + 1
