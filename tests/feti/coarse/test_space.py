from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from scipy.optimize import minimize
from torn import column

from fenics_tfeti.feti import TornSolver
from fenics_tfeti.feti.coarse.feasible_start import least_norm_nonnegative
from fenics_tfeti.feti.coarse.projector import Projector

SOLVER = TornSolver(column())
SPACE = SOLVER.setup.projector.coarse_space
G = np.stack([SPACE.restrict(column) for column in np.eye(SOLVER.data.feasible.size)], axis=1)
R = scipy.linalg.block_diag(*SOLVER.setup.local.kernels)
P = SOLVER.setup.projector


def test_coarse_matrix_is_kernel_times_constraints():
    B = SOLVER.setup.constraints.matrix.toarray()
    np.testing.assert_allclose(G, R.T @ B.T, atol=1e-14)


def test_prolongation_is_the_transpose_of_the_restriction():
    columns = np.stack([SPACE.prolong(a) for a in np.eye(SPACE.size)], axis=0)
    np.testing.assert_allclose(columns, G, atol=1e-14)


def test_projector_is_that_of_orthonormal_rows():
    """Q = G'G for G with orthonormal rows, here from an SVD."""
    rows = np.linalg.svd(G, full_matrices=False)[2]
    x = np.random.default_rng(0).standard_normal(G.shape[1])
    np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), atol=1e-13)
    np.testing.assert_allclose(P.Q(x), rows.T @ (rows @ x), atol=1e-12)


def test_projection_is_in_the_kernel_of_G():
    x = np.random.default_rng(1).standard_normal(G.shape[1])
    np.testing.assert_allclose(G @ P.P(x), 0.0, atol=1e-13)


def test_equalities_alone_leave_the_upper_body_free_to_sink_and_tilt():
    none = np.zeros(SOLVER.setup.constraints.inequality.size, dtype=bool)
    assert Projector.build(SPACE, none).free.shape[1] == 3
    assert P.free.shape[1] == 0


def test_feasible_start():
    start = SOLVER.data.feasible
    e = R.T @ SOLVER.data.load
    np.testing.assert_allclose(G @ start, e, atol=1e-12)
    assert np.all(start[SOLVER.setup.constraints.inequality] >= 0)


def test_feasible_start_of_lemma_11_1_has_no_contact_forces():
    coercive = TornSolver(column(load=(0, 0, 0)))
    assert not coercive.data.feasible[coercive.setup.constraints.inequality].any()


@pytest.mark.parametrize("seed", range(5))
def test_least_norm_nonnegative_fulfils_its_conditions(seed):
    rng = np.random.default_rng(seed)
    C = rng.standard_normal((4, 30))
    d = C @ rng.random(30)
    x, residual = least_norm_nonnegative(C, d)
    np.testing.assert_allclose(C @ x, d, atol=1e-10)
    assert np.all(x >= 0) and np.linalg.norm(residual) < 1e-10
    other = minimize(
        lambda z: 0.5 * z @ z,
        np.ones(30),
        jac=lambda z: z,
        bounds=[(0, None)] * 30,
        constraints={"type": "eq", "fun": lambda z: C @ z - d, "jac": lambda z: C},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(x, other.x, atol=1e-5)


def test_least_norm_nonnegative_certifies_that_there_is_no_solution():
    C, d = np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([-1.0, 1.0])
    _, residual = least_norm_nonnegative(C, d)
    assert np.all(C.T @ residual <= 1e-12) and d @ residual > 0.1
