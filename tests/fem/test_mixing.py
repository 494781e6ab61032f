"""Anderson mixing on a linear iteration, whose fixed point it finds."""

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.fem.newton.mixing import AndersonMixing, Iterate


@pytest.mark.parametrize("n", [1, 3])
def test_as_many_mixed_steps_as_unknowns_end_at_the_fixed_point(n):
    rng = np.random.default_rng(n)
    iteration, of_multipliers = 0.5 * rng.standard_normal((n, n)), rng.standard_normal((2, n))
    fixed = rng.standard_normal(n)

    def step(x):
        end = fixed + iteration @ (x - fixed)
        return Iterate(x, end - x, of_multipliers @ end)

    mixing, x = AndersonMixing(MPI.COMM_SELF, n, accuracy=1e-12), np.zeros(n)
    for _ in range(2):
        first = step(x)
        assert mixing.mix(first) is None
        x = x + first.increment
        for _ in range(n):
            mixed = mixing.mix(step(x))
            x = x + mixed.increment
        np.testing.assert_allclose(x, fixed, rtol=1e-9)
        np.testing.assert_allclose(mixed.multipliers, of_multipliers @ fixed, rtol=1e-9)
        mixing.forget()
        x = rng.standard_normal(n)


@pytest.mark.parametrize(("accuracy", "is_fitted"), [(1e-3, False), (1e-12, True)])
def test_errors_of_steps_are_not_fitted(accuracy, is_fitted):
    """The differences are along the first axis but for 1e-5; 1e-2 along the second is in all."""
    increments = np.array([[1.0, 1e-2], [0.5, 1e-2 + 1e-5], [0.25, 1e-2]])
    mixing, x = AndersonMixing(MPI.COMM_SELF, 2, accuracy), np.zeros(2)
    for increment in increments:
        mixed = mixing.mix(Iterate(x, increment, np.zeros(0)))
        x = x + increment
    assert (np.linalg.norm(mixed.increment) > 1.0) == is_fitted


def test_repeated_steps_are_taken_as_they_are():
    """Their difference is zero, and has no direction."""
    mixing, step = AndersonMixing(MPI.COMM_SELF, 2, accuracy=1e-8), Iterate(*np.eye(3))
    for _ in range(3):
        mixed = mixing.mix(step)
    np.testing.assert_array_equal([mixed.increment, mixed.multipliers], np.eye(3)[1:])
