"""The self-test on several processes."""

from __future__ import annotations

from mpi4py import MPI

from fenics_tfeti.__main__ import facts, self_test

COMM = MPI.COMM_WORLD


def test_self_test_is_the_same_on_all_ranks():
    result = self_test(COMM)
    assert result[0] < 1e-6
    assert COMM.allgather(result) == [result] * COMM.size


def test_facts_are_the_same_on_all_ranks():
    found = facts(COMM)
    assert found["processes"] == str(COMM.size)
    assert COMM.allgather(found) == [found] * COMM.size
