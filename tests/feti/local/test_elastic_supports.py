"""A subdomain with the ground of its soft supports floats."""

import numpy as np
import pytest
from springs import on_springs
from torn import cube

from fenics_tfeti.feti.local.elastic_supports import set_free

pytestmark = pytest.mark.once

CUBE = cube(2)


@pytest.mark.parametrize("stiffness", [1e-12, 1e-8, 1e-4])
def test_kernel_moves_the_ground_along(stiffness):
    floating = set_free(on_springs(CUBE, 0.0, stiffness))
    assert floating.grounds == 6
    K = floating.stiffness.toarray()
    np.testing.assert_allclose(K @ floating.kernel, 0.0, atol=1e-15 / np.sqrt(stiffness))
    np.testing.assert_allclose(K, K.T, atol=1e-16)
    assert np.linalg.matrix_rank(K, tol=1e-10, hermitian=True) == CUBE.size
    R = floating.kernel[: CUBE.size]
    np.testing.assert_allclose(R.T @ R, np.eye(6), atol=1e-14)


def test_stiffness_is_the_given_one_where_the_ground_is_held():
    supported = on_springs(CUBE, 0.0, 1e-6)
    K = set_free(supported).stiffness[: CUBE.size, : CUBE.size]
    np.testing.assert_array_equal(K.toarray(), supported.stiffness.toarray())


@pytest.mark.parametrize("stiffness", [1e-12, 1e-8, 1e-4])
def test_modes_beside_the_springs_stay_in_the_kernel(stiffness):
    floating = set_free(on_springs(CUBE, 0.0, stiffness, components=(2,)))
    assert floating.grounds == 3
    at_rest = ~floating.kernel[CUBE.size :].any(axis=0)
    assert np.count_nonzero(at_rest) == 3
    assert np.abs(floating.kernel[2 : CUBE.size : 3, at_rest]).max() <= 1e-14


def test_nothing_changes_without_soft_supports():
    assert set_free(CUBE).stiffness is CUBE.stiffness
    firm = on_springs(CUBE, 0.0, 1.0)
    assert set_free(firm).stiffness is firm.stiffness
    assert set_free(firm).kernel.shape == (CUBE.size, 0)
