"""Errors of some ranks are raised on all."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from fenics_tfeti.parallel import raise_collectively

COMM = MPI.COMM_WORLD


class OddError(Exception):
    """An error that pickle cannot make again."""

    def __init__(self, first, second):
        super().__init__(first)


@pytest.mark.parametrize("rank", [0, COMM.size - 1])
def test_error_of_one_rank_is_raised_on_all(rank):
    with pytest.raises(ValueError, match=f"of rank {rank}"), raise_collectively(COMM):
        if COMM.rank == rank:
            raise ValueError(f"of rank {rank}")


def test_of_several_errors_all_raise_the_first():
    with pytest.raises(ValueError, match="of rank 0"), raise_collectively(COMM):
        raise ValueError(f"of rank {COMM.rank}")


def test_error_that_cannot_be_sent_is_raised_on_all():
    last = COMM.size - 1
    expected = OddError if COMM.rank == last else RuntimeError
    with pytest.raises(expected, match="odd"), raise_collectively(COMM):
        if COMM.rank == last:
            raise OddError("odd", "error")
