"""The reference solver itself, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from primal_reference import primal_active_set

pytestmark = pytest.mark.once


def chain(springs: list[float]) -> sp.csr_matrix:
    """Return the stiffness matrix of springs in series, singular: nothing is fixed."""
    n = len(springs) + 1
    K = sp.lil_matrix((n, n))
    for i, k in enumerate(springs):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return K.tocsr()


def row(n: int, *entries: tuple[int, float]) -> sp.csr_matrix:
    C = sp.lil_matrix((1, n))
    for column, value in entries:
        C[0, column] = value
    return C.tocsr()


@pytest.mark.parametrize("push", [0.5, 1.0, 3.0])
def test_two_bars_and_a_gap(push):
    """Bars of stiffness 2 and 3, gap 1, pushed together: force = (push - 1) / (1/2 + 1/3)."""
    K = sp.block_diag([chain([2.0]), chain([3.0])], format="csr")
    C = row(4, (1, 1.0), (2, -1.0))
    found = primal_active_set(
        K, np.zeros(4), np.array([0, 3]), np.array([push, 0.0]), C, np.array([1.0])
    )
    force = max(push - 1.0, 0.0) / (1.0 / 2.0 + 1.0 / 3.0)
    np.testing.assert_allclose(found.forces, [force], atol=1e-14)
    np.testing.assert_allclose(found.displacement[1], push - force / 2.0, rtol=1e-14)


def test_contact_alone_holds_a_floating_body():
    """K is singular without the contact row; the force is the load."""
    found = primal_active_set(
        chain([2.0, 5.0]),
        np.array([1.0, 2.0, 4.0]),
        np.array([], dtype=int),
        np.array([]),
        row(3, (2, 1.0)),
        np.array([0.25]),
    )
    np.testing.assert_allclose(found.forces, [7.0], rtol=1e-14)
    np.testing.assert_allclose(found.displacement, [0.25 + 3 / 5 + 1 / 2, 0.85, 0.25], rtol=1e-14)


def test_string_over_an_obstacle():
    """-u'' = -1 on (0, 1), u >= -1/32: u touches on [1/4, 3/4] and leaves it with slope zero."""
    n = 64
    h = 1.0 / n
    K = n * chain([1.0] * n)
    x = np.linspace(0.0, 1.0, n + 1)
    inner = np.arange(1, n)
    C = -sp.identity(n + 1, format="csr")[inner]
    found = primal_active_set(
        K, np.full(n + 1, -h), np.array([0, n]), np.zeros(2), C, np.full(n - 1, 1.0 / 32.0)
    )
    s = np.minimum(np.minimum(x, 1.0 - x), 0.25)
    np.testing.assert_allclose(found.displacement, 0.5 * s**2 - 0.25 * s, atol=1e-14)
    # Where the string rests, the obstacle carries its weight, half of it at the two ends.
    rests = (x[inner] >= 0.25) & (x[inner] <= 0.75)
    expected = np.where(rests, h, 0.0)
    expected[(x[inner] == 0.25) | (x[inner] == 0.75)] = 0.5 * h
    np.testing.assert_allclose(found.forces, expected, atol=1e-14)


def test_a_row_between_fixed_dofs_is_only_checked():
    K = chain([1.0, 1.0])
    C = sp.vstack([row(3, (0, 1.0)), row(3, (1, 1.0))])
    found = primal_active_set(
        K, np.array([0.0, 5.0, 0.0]), np.array([0, 2]), np.zeros(2), C, np.array([0.1, 1.0])
    )
    np.testing.assert_allclose(found.forces, [0.0, 3.0], rtol=1e-14)


def test_a_body_that_nothing_holds_is_an_error():
    K = sp.block_diag([chain([1.0]), chain([1.0])], format="csr")
    with pytest.raises(RuntimeError, match="singular"):
        primal_active_set(
            K, np.ones(4), np.array([0]), np.zeros(1), row(4, (1, 1.0)), np.array([1.0])
        )
