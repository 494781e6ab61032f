"""The self-test on several processes."""

from __future__ import annotations

from mpi4py import MPI

from fenics_tfeti.installation import facts
from fenics_tfeti.self_test import self_test

COMM = MPI.COMM_WORLD


def test_self_test_is_the_same_on_all_ranks():
    result = self_test(COMM)
    assert result.passed
    assert COMM.allgather(result) == [result] * COMM.size


def test_facts_are_the_same_on_all_ranks():
    found = facts(COMM)
    assert found["processes"] == str(COMM.size)
    assert COMM.allgather(found) == [found] * COMM.size
