"""The self-test on several processes."""

from __future__ import annotations

from mpi4py import MPI

from fenics_tfeti.__main__ import facts, self_test

COMM = MPI.COMM_WORLD


def test_self_test_and_facts_are_the_same_on_all_ranks():
    result, found = self_test(COMM), facts(COMM)
    assert result[0] < 1e-6
    assert found["processes"] == str(COMM.size)
    assert COMM.allgather((result, found)) == [(result, found)] * COMM.size
