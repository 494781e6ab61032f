"""The Lanczos bound against known spectra."""

import numpy as np
import pytest
from qp_problems import membranes

from fenics_tfeti.qp import lanczos_estimate

pytestmark = pytest.mark.once


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("steps", [10, 15])
def test_estimate_is_safe_for_the_step_length(seed, steps):
    """A step of 1.9 / estimate has to stay below 2 / ||A||, which leaves 5 % to underestimate."""
    A = membranes().A
    start = np.random.default_rng(seed).standard_normal(len(A))
    largest = np.linalg.eigvalsh(A)[-1]
    estimate = lanczos_estimate(lambda x: A @ x, start, steps)
    assert 0.95 * largest < estimate < 1.3 * largest


@pytest.mark.parametrize(("values", "steps", "calls", "expected"), [
    (np.arange(1.0, 7.0), 6, 6, 6.0),  # all eigenvectors
    (np.full(5, 3.0), 10, 1, 3.0),  # an invariant subspace ends it early
    (np.zeros(3), 5, 1, 0.0),
])  # fmt: skip
def test_steps(values, steps, calls, expected):
    products = []

    def operator(x):
        products.append(x)
        return values * x

    estimate = lanczos_estimate(operator, np.ones(values.size), steps)
    assert estimate == pytest.approx(expected, rel=1e-12, abs=0.0)
    assert len(products) == calls


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scale(scale):
    values, start = np.arange(1.0, 31.0), np.random.default_rng(0).standard_normal(30)
    plain = lanczos_estimate(lambda x: values * x, start, 8)
    scaled = lanczos_estimate(lambda x: scale * values * x, start, 8)
    assert scaled == pytest.approx(scale * plain, rel=1e-10)


def test_zero_start():
    assert lanczos_estimate(lambda x: x, np.zeros(3), 5) == 0.0
