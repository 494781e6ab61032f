"""Projection, active set and split gradient, by their definitions, on a feasible set by hand."""

from __future__ import annotations

import numpy as np
import pytest

from fenics_tfeti.qp import Bounds, Space

INF = np.inf
BOUNDS = Bounds.from_vector(np.array([-INF, 0.0, 1.0, -2.0]))


def test_bounds_from_a_vector_take_the_finite_ones():
    assert BOUNDS.indices.tolist() == [1, 2, 3]
    assert BOUNDS.lower.tolist() == [0.0, 1.0, -2.0]


def test_projection_is_the_nearest_feasible_point():
    assert BOUNDS.project(np.array([-9.0, -9.0, 3.0, -2.0])).tolist() == [-9.0, 0.0, 3.0, -2.0]


def test_active_bounds_hold_exactly():
    x = BOUNDS.project(np.array([0.0, -1.0, 1.0 + 1e-15, -2.0]))
    assert BOUNDS.active(x).tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("direction", "length"),
    [
        ((1.0, 0.0, 0.0, 0.0), INF),  # no bound
        ((0.0, -1.0, -1.0, -1.0), INF),  # away from all bounds
        ((5.0, 1.0, 1.0, 2.0), 1.5),  # to the bound of the last one
        ((0.0, 4.0, 1.0, 0.0), 0.5),
    ],
)
def test_longest_step(direction, length):
    x = np.array([0.0, 2.0, 3.0, 1.0])
    assert BOUNDS.longest_step(x, np.array(direction)) == length


def test_split_of_the_gradient():
    """Component 1 is active and wants to leave, 2 is active and stays, 3 is near its bound."""
    x, g = np.array([7.0, 0.0, 1.0, -1.5]), np.array([3.0, -4.0, 5.0, 6.0])
    Qx, Ap = np.array([1.0, 2.0, 0.0, 0.0]), np.array([1.0, 1.0, 1.0, 1.0])
    split = BOUNDS.split(x, g, 0.25, Space(), Qx, Ap)
    assert split.free.tolist() == [3.0, 0.0, 0.0, 6.0]
    assert split.chopped.tolist() == [-4.0, 0.0, 0.0]
    assert split.free2 == 9.0 + 36.0
    assert split.chopped2 == 16.0
    assert split.reduced_free == 3.0 * 3.0 + (0.5 / 0.25) * 6.0
    assert split.constraint2 == 5.0
    assert split.conjugation == 9.0
    assert split.projected_norm == pytest.approx(np.sqrt(61.0), rel=1e-15)
    assert split.constraint_norm == pytest.approx(np.sqrt(5.0), rel=1e-15)


def test_split_counts_owned_components_only():
    x, g = np.array([7.0, 0.0, 1.0, -1.5]), np.array([3.0, -4.0, 5.0, 6.0])
    split = BOUNDS.split(x, g, 0.25, Space(owned=2))
    assert split.free.tolist() == [3.0, 0.0, 0.0, 6.0]
    assert (split.free2, split.chopped2, split.reduced_free) == (9.0, 16.0, 9.0)
    assert (split.constraint2, split.conjugation) == (0.0, 0.0)
