"""Rows that hold the ground of soft elastic supports."""

import numpy as np
import pytest
from springs import pressed_column
from torn import column

from fenics_tfeti.feti.constraints.ground import TornUnknowns, hold_ground
from fenics_tfeti.feti.constraints.rows import build_constraints

pytestmark = pytest.mark.once

SYSTEM = pressed_column(1e-6)
SIZES = np.array([s.size for s in SYSTEM.subdomains])
UNKNOWNS = TornUnknowns(SIZES, np.array([6, 0, 3]))


def test_displacements_and_ground():
    u = np.arange(1.0, SIZES.sum() + 1.0)
    torn = UNKNOWNS.with_ground(u)
    assert np.count_nonzero(torn == 0.0) == 9
    np.testing.assert_array_equal(np.concatenate(UNKNOWNS.split(torn)), u)
    np.testing.assert_array_equal(UNKNOWNS.without_ground(torn), u)
    assert UNKNOWNS.ends.tolist() == np.cumsum([0, SIZES[0] + 6, SIZES[1], SIZES[2] + 3]).tolist()


def test_rows_of_the_ground_are_orthonormal_and_all_others_stay():
    plain, c = build_constraints(SYSTEM, np.linspace(0.5, 1.0, SIZES.sum() // 3))
    held, right = hold_ground(plain, c, UNKNOWNS)
    B = held.matrix.toarray() / np.sqrt(held.weights)
    new = np.setdiff1d(
        np.arange(held.size), np.searchsorted(held.layout.numbers, plain.layout.numbers)
    )
    assert new.size == 9
    np.testing.assert_allclose(B[new] @ B.T, np.eye(held.size)[new], atol=1e-14)
    others = np.setdiff1d(np.arange(held.size), new)
    displacements = held.matrix.toarray()[others][:, UNKNOWNS.displacements]
    np.testing.assert_array_equal(displacements, plain.matrix.toarray())
    np.testing.assert_array_equal(right[others], c)
    assert not right[new].any()
    assert held.equality[new].all()
    np.testing.assert_array_equal(
        held.layout.numbers[held.inequality], plain.layout.numbers[plain.inequality]
    )


def test_without_ground_vectors_and_constraints_are_the_same_objects():
    system = column()
    constraints, c = build_constraints(system)
    sizes = np.array([s.size for s in system.subdomains])
    plain, u = TornUnknowns(sizes, np.zeros(3, dtype=np.int64)), np.ones(sizes.sum())
    assert plain.with_ground(u) is u and plain.without_ground(u) is u
    assert hold_ground(constraints, c, plain)[0] is constraints
