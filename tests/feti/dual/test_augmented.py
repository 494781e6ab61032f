"""The Hessian of the augmented dual problem (11.40), against dense algebra."""

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.dual.augmented import augmented_hessian

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
