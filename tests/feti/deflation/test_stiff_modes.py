"""Stiff modes against dense eigenvalues."""

import numpy as np
import pytest

from fenics_tfeti.feti.deflation.stiff_modes import STIFF, StiffModes

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
    """S v = theta D v, the vectors orthonormal in units of D^{1/2}."""
    S, theta, modes = stiff
    np.testing.assert_allclose(modes.values, theta[:-13:-1], rtol=1e-8)
    V = modes.vectors
    np.testing.assert_allclose(V.T @ V, np.identity(12), atol=1e-12)
    found = V.T @ (S / np.sqrt(np.outer(weights, weights))) @ V
    np.testing.assert_allclose(found, np.diag(theta[:-13:-1]), atol=1e-9 * theta.max())


@pytest.mark.parametrize(
    ("theta", "few"),
    [
        (np.linspace(0.0, 0.9 * STIFF, SIZE), 31),
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
    assert sum(products) <= few
