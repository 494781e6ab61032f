"""Anderson mixing on a linear iteration, whose fixed point it finds."""

from __future__ import annotations

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

    mixing, x = AndersonMixing(MPI.COMM_SELF, n), np.zeros(n)
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
