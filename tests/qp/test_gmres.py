"""GMRES on small systems, with exact and with changing preconditioners."""

import numpy as np
import pytest

from fenics_tfeti.qp import Space
from fenics_tfeti.qp.gmres import gmres

pytestmark = pytest.mark.once

RNG = np.random.default_rng(0)
A = np.eye(6) + 0.3 * RNG.standard_normal((6, 6))
X = RNG.standard_normal(6)


def preconditioned(exact=False):
    """Return a step with A itself, or with another matrix in each step."""
    rng = np.random.default_rng(1)

    def step(v):
        M = A if exact else A + 0.5 * rng.standard_normal(A.shape)
        z = np.linalg.solve(M, v)
        return z, A @ z

    return step


@pytest.mark.parametrize(("step", "steps"), [
    (lambda v: (v, A @ v), 6),
    (preconditioned(), 6),
    (preconditioned(exact=True), 1),
])  # fmt: skip
def test_exact_solution(step, steps):
    z, y, left = gmres(step, A @ X, Space(), tolerance=1e-12, max_it=10)
    assert len(z) == steps
    assert left <= 1e-12
    np.testing.assert_allclose(np.transpose(z) @ y, X, rtol=0.0, atol=1e-12)


def test_residual_that_is_left():
    """It is that of the best combination of few steps."""
    z, y, left = gmres(preconditioned(), A @ X, Space(), tolerance=0.0, max_it=3)
    Z = np.transpose(z)
    best = np.linalg.lstsq(A @ Z, A @ X, rcond=None)[0]
    np.testing.assert_allclose(y, best, atol=1e-12)
    assert left == pytest.approx(np.linalg.norm(A @ (X - Z @ y)), rel=1e-10)


def test_nothing_to_do():
    z, y, left = gmres(preconditioned(), np.zeros(6), Space(), tolerance=0.0, max_it=10)
    assert (len(z), y.size, left) == (0, 0, 0.0)


def test_singular_system_ends_with_the_invariant_subspace():
    P = np.diag([1.0, 1.0, 0.0])
    z, _, left = gmres(lambda v: (v, P @ v), np.ones(3), Space(), tolerance=0.0, max_it=10)
    assert len(z) == 2
    assert left == pytest.approx(1.0)


def test_vector_in_parts():
    """Inner products are those of the components that are owned."""
    z, y, _ = gmres(
        lambda v: (v, np.append(A[:4, :4] @ v[:4], v[4:])),
        np.append(A[:4, :4] @ X[:4], X[4:]),
        Space(4),
        tolerance=1e-12,
        max_it=10,
    )
    np.testing.assert_allclose((np.transpose(z) @ y)[:4], X[:4], atol=1e-11)
