"""Errors in a block on one rank; tests/mpi/test_parallel.py has those on several."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from fenics_tfeti.errors import NotConverged
from fenics_tfeti.parallel import raise_collectively


class OddError(Exception):
    """An error that pickle cannot make again."""

    def __init__(self, first, second):
        super().__init__(first)


@pytest.mark.parametrize(
    "error",
    [ValueError("bad"), OddError("a", "b"), NotConverged("limit", solution=iter(lambda: 0, 1))],
)
def test_error_is_the_one_that_was_raised(error):
    with pytest.raises(type(error)) as caught, raise_collectively(MPI.COMM_SELF):
        raise error
    assert caught.value is error


def test_block_without_error_goes_on():
    done = []
    with raise_collectively(MPI.COMM_SELF):
        done.append(1)
    assert done == [1]


def test_interrupt_is_not_kept_back():
    with pytest.raises(KeyboardInterrupt), raise_collectively(MPI.COMM_SELF):
        raise KeyboardInterrupt
