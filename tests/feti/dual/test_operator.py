"""F = B K^+ B' on vectors, against dense algebra with another generalized inverse."""

from __future__ import annotations

import numpy as np
import pytest
from dense import DenseSystem
from torn import column

from fenics_tfeti.feti import Options, TornSolver
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector

each_kind = pytest.mark.parametrize("kind", ["implicit", "explicit"])


def solver(kind: str, **arguments) -> tuple[TornSolver, DenseSystem]:
    torn = TornSolver(column(height=3), Options(dual_operator=kind, **arguments))
    return torn, DenseSystem.of(torn)


@each_kind
def test_projected_operator_and_load(kind):
    """PFP and Pd do not depend on the generalized inverse; Pd of forces in the range of K."""
    torn, system = solver(kind)
    F, P = torn.setup.F, system.projector()
    # all cubes of the column are congruent: one class
    assert F.explicit == (kind == "explicit")
    found = np.stack([F(unit) for unit in np.eye(len(P))], axis=1)
    exact = P @ system.F @ P
    np.testing.assert_allclose(P @ found @ P, exact, rtol=0.0, atol=1e-12 * np.abs(exact).max())
    rng = np.random.default_rng(0)
    f, c = system.K @ rng.standard_normal(len(system.K)), rng.standard_normal(len(system.B))
    K_plus = np.linalg.pinv(system.K, rcond=1e-10, hermitian=True)
    exact = P @ (system.B @ K_plus @ f - c)
    found = P @ F.load(f, c)
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-11 * np.abs(exact).max())


@each_kind
def test_constraints_and_generalized_inverse(kind):
    torn, system = solver(kind)
    rng = np.random.default_rng(0)
    multipliers, u = rng.standard_normal(len(system.B)), rng.standard_normal(len(system.K))
    F = torn.setup.F
    np.testing.assert_allclose(F.constraint_forces(multipliers), system.B.T @ multipliers)
    np.testing.assert_allclose(F.jumps(u), system.B @ u, atol=1e-14)
    KK = np.stack([F.generalized_inverse(k) for k in system.K], axis=1)
    np.testing.assert_allclose(system.K @ KK, system.K, atol=1e-11 * np.abs(system.K).max())


@pytest.mark.parametrize("steps", [8, 15])
def test_norm_is_an_upper_bound_and_estimated_once(steps):
    torn, system = solver("explicit")
    P, norm = system.projector(), torn.setup.norm
    largest = np.linalg.norm(P @ system.F @ P, 2)
    products = norm.products
    assert 0.95 * largest <= norm(steps) <= 1.3 * largest
    assert norm.products == products + steps
    assert norm(steps - 1) == norm(steps)
    assert norm.products == products + steps


def test_random_components_depend_on_their_numbers_only():
    whole = seeded_vector(np.arange(10_000))
    np.testing.assert_array_equal(seeded_vector(np.array([7, 3, 9_999])), whole[[7, 3, 9_999]])
    assert np.all(np.abs(whole) <= 1.0)
    assert abs(whole.mean()) < 0.02
    assert np.std(whole) == pytest.approx(np.sqrt(1.0 / 3.0), rel=0.02)
