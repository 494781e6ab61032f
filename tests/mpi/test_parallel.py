"""Errors of some ranks are raised on all."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.parallel import raise_collectively, values_of_owners

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


def test_values_of_numbers_of_all_ranks():
    """Rank r owns r + 1 numbers and asks for every third one, the last rank for none."""
    first = COMM.rank * (COMM.rank + 1) // 2
    own = np.arange(first, first + COMM.rank + 1)
    asked = np.arange(COMM.rank, COMM.size * (COMM.size + 1) // 2, 3)
    if COMM.rank == COMM.size - 1:
        asked = asked[:0]
    values = np.column_stack([own, own**2])
    found = values_of_owners(COMM, (own[0], own[-1] + 1), values, asked)
    np.testing.assert_array_equal(found, np.column_stack([asked, asked**2]))
