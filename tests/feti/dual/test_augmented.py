"""The Hessian of the augmented dual problem (11.40), against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.dual.augmented import augmented_hessian, solve_by_smalbe
from fenics_tfeti.feti.dual.iterate import Iterate, SolveStatus, Turn
from fenics_tfeti.qp import Products

pytestmark = pytest.mark.once

SOLVER = TornSolver(column())
SYSTEM = DenseSystem.of(SOLVER)


@pytest.mark.parametrize("rho", [1.0, 0.01, 100.0])
def test_hessian(rho):
    """PFP / ||PFP|| + rho Q with the norm that the problem states."""
    problem = SOLVER.dual_problem()
    apply = augmented_hessian(problem, rho)
    products = [apply(unit) for unit in np.eye(len(SYSTEM.B))]
    P = SYSTEM.projector()
    Q = np.eye(len(P)) - P
    exact = P @ SYSTEM.F @ P / problem.norm + rho * Q
    found = np.stack([product for product, _ in products], axis=1)
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-11 * max(1.0, rho))
    np.testing.assert_allclose(np.stack([Qx for _, Qx in products], axis=1), Q, atol=1e-11)
    largest = np.linalg.eigvalsh(exact)[-1]
    assert 0.9 * max(1.0, rho) <= largest <= 1.0001 * max(1.0, rho)


def test_flat_direction_ends_smalbe_and_leaves_the_iterate():
    """Glued bodies without curvature of F; the sentence says so.

    No bound ends the first step, after which rounding would decide which directions are flat.
    """
    flat = replace(TornSolver(column(contact=False)).dual_problem(), F=np.zeros_like)
    start = Iterate(flat.feasible)
    turn = Turn(1e-12, 1000, Products(), monitor=lambda step: None)
    found = solve_by_smalbe(flat, start, turn)
    assert found.status is SolveStatus.FLAT
    assert found.multipliers is start.multipliers
    assert found.status.describe(Options()).startswith("SMALBE-M found no curvature along a")
