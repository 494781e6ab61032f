"""The Lanczos bound against known spectra."""

from __future__ import annotations

import numpy as np
import pytest
from qp_problems import membranes

from fenics_tfeti.qp import lanczos_upper_bound

pytestmark = pytest.mark.once


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("steps", [10, 15])
def test_estimate_is_safe_for_the_step_length(seed, steps):
    """A step of 1.9 / estimate has to stay below 2 / ||A||, which leaves 5 % to underestimate."""
    A = membranes().A
    start = np.random.default_rng(seed).standard_normal(len(A))
    largest = np.linalg.eigvalsh(A)[-1]
    estimate = lanczos_upper_bound(lambda x: A @ x, start, steps)
    assert 0.95 * largest < estimate < 1.3 * largest


def test_all_steps_give_the_eigenvalue():
    values = np.arange(1.0, 7.0)
    assert lanczos_upper_bound(lambda x: values * x, np.ones(6), 6) == pytest.approx(6.0, rel=1e-12)


def test_invariant_subspace_ends_it_early():
    calls = []

    def operator(x):
        calls.append(x)
        return 3.0 * x

    assert lanczos_upper_bound(operator, np.ones(5), 10) == pytest.approx(3.0, rel=1e-14)
    assert len(calls) == 1


def test_products_are_the_steps():
    calls = []

    def operator(x):
        calls.append(x)
        return np.arange(1.0, 31.0) * x

    lanczos_upper_bound(operator, np.random.default_rng(0).standard_normal(30), 7)
    assert len(calls) == 7


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scale(scale):
    values, start = np.arange(1.0, 31.0), np.random.default_rng(0).standard_normal(30)
    plain = lanczos_upper_bound(lambda x: values * x, start, 8)
    scaled = lanczos_upper_bound(lambda x: scale * values * x, start, 8)
    assert scaled == pytest.approx(scale * plain, rel=1e-10)


def test_zero_operator_and_zero_start():
    assert lanczos_upper_bound(lambda x: 0.0 * x, np.ones(3), 5) == 0.0
    assert lanczos_upper_bound(lambda x: x, np.zeros(3), 5) == 0.0
