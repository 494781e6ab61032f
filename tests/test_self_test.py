"""The self-test of an installation."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from fenics_tfeti.self_test import SelfTest, self_test


def test_self_test_is_exact():
    result = self_test(MPI.COMM_SELF)
    assert result.passed
    assert result.error < 1e-6
    assert 0 < result.products < 100


@pytest.mark.parametrize(("error", "passed"), [(1e-9, True), (1e-5, False)])
def test_verdict(error, passed):
    assert SelfTest(error, 10, 1.0).passed == passed
