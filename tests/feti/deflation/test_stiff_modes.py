"""Stiff modes against dense eigenvalues, and the capped stiffness."""

import numpy as np
import pytest

from fenics_tfeti.feti.deflation.stiff_modes import CAP, StiffModes

pytestmark = pytest.mark.once

SIZE = 150


@pytest.fixture
def weights():
    return np.random.default_rng(1).uniform(0.5, 2.0, SIZE)


def with_eigenvalues(theta, weights):
    """Return S of which D^{-1/2} S D^{-1/2} has eigenvalues theta."""
    Q = np.linalg.qr(np.random.default_rng(2).standard_normal((SIZE, SIZE)))[0]
    root = np.sqrt(weights)
    return root[:, None] * (Q * theta) @ Q.T * root


@pytest.fixture
def stiff(weights):
    """Return S with twelve stiff modes, theta, and the modes that are found."""
    theta = np.append(np.linspace(0.0, 3.0, SIZE - 12), np.geomspace(150.0, 1e5, 12))
    S = with_eigenvalues(theta, weights)
    x = np.random.default_rng(3).standard_normal(SIZE)
    return S, theta, StiffModes.build(lambda u: u @ S, weights, x)


def test_modes_are_those_of_dense_algebra(stiff, weights):
    """The capped stiffness has no larger eigenvalue; the deflated vector is in their span."""
    S, theta, modes = stiff
    np.testing.assert_allclose(modes.values, theta[:-13:-1], rtol=1e-8)
    capped = modes.capped(lambda u: u @ S)(np.identity(SIZE))
    found = np.linalg.eigvalsh(capped / np.sqrt(np.outer(weights, weights)))
    np.testing.assert_allclose(found, np.minimum(theta, CAP), atol=1e-9 * theta.max())
    span, vector = modes.vectors / modes.root[:, None], modes.deflated
    residual = vector - span @ np.linalg.lstsq(span, vector, rcond=None)[0]
    assert np.abs(residual).max() < 1e-9 * np.abs(vector).max()


@pytest.mark.parametrize(
    ("theta", "few"),
    [
        (np.linspace(0.0, 0.9 * CAP, SIZE), 31),
        (np.append(np.linspace(0.0, 3.0, 40), np.geomspace(5e4, 2e5, SIZE - 40)), SIZE),
    ],
    ids=["no large eigenvalues", "displacements that lock: many, not all of which are found"],
)
def test_no_modes(weights, theta, few):
    S, products = with_eigenvalues(theta, weights), []

    def reaction(u):
        products.append(len(u))
        return u @ S

    modes = StiffModes.build(reaction, weights, np.ones(SIZE))
    assert not modes.values.size
    assert not modes.deflated.any()
    assert sum(products) <= few
