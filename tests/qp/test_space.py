"""Inner products with vectors of one process, and with parts that several processes own."""

import numpy as np
import pytest

from fenics_tfeti.qp import Space

pytestmark = pytest.mark.once

X, Y = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])


def test_one_process():
    """Components that are not owned do not count."""
    assert Space().dots((X, Y), (X, X)) == [32.0, 14.0]
    assert Space().norm(X) == pytest.approx(np.sqrt(14.0), rel=1e-15)
    assert Space().dots_and_min((X, Y), value=-2.0) == [32.0, -2.0]

    assert Space(owned=2).dots((X, Y)) == [14.0]
    assert Space(owned=0).norm(X) == 0.0


def test_several_products_are_one_reduction():
    """The second of two processes holds the same numbers: sums are twice the partial ones."""
    calls = []

    def twice(partial):
        calls.append(partial.size)
        return 2.0 * partial

    def twice_and_min(partial):
        calls.append(partial.size)
        return np.append(2.0 * partial[:-1], partial[-1])

    space = Space(2, twice, twice_and_min)
    assert space.dots((X, Y), (X, X), (Y, Y)) == [28.0, 10.0, 82.0]
    assert space.dots_and_min((X, Y), (X, X), value=7.0) == [28.0, 10.0, 7.0]
    assert calls == [3, 3]
