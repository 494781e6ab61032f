"""Errors in a block, on one rank and on several."""

import time

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.errors import InputError, NotConverged
from fenics_tfeti.parallel import Directory, meet, raise_collectively

COMM = MPI.COMM_WORLD


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


@pytest.mark.ranks(2)
@pytest.mark.parametrize("rank", [0, COMM.size - 1])
def test_error_of_one_rank_is_raised_on_all(rank):
    with pytest.raises(ValueError, match=f"of rank {rank}"), raise_collectively(COMM):
        if COMM.rank == rank:
            raise ValueError(f"of rank {rank}")


@pytest.mark.ranks(2)
def test_of_several_errors_all_raise_the_first():
    with pytest.raises(ValueError, match="of rank 0"), raise_collectively(COMM):
        raise ValueError(f"of rank {COMM.rank}")


@pytest.mark.ranks(2)
def test_error_that_cannot_be_sent_is_raised_on_all():
    last = COMM.size - 1
    expected = OddError if COMM.rank == last else RuntimeError
    with pytest.raises(expected, match="odd"), raise_collectively(COMM):
        if COMM.rank == last:
            raise OddError("odd", "error")


@pytest.mark.ranks(2)
def test_tables_and_sums_at_home():
    """Each rank has the keys 5 and 10 + rank; rows with the key 7 are left out."""
    keys = np.array([5, 10 + COMM.rank])
    directory = Directory(COMM, keys)
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    rows = np.append(keys, 7)
    sums = directory.sums(rows, values)
    (single,) = directory.table(rows, values[:, 0])
    found = directory.lookup(keys, sums, directory.sums(rows, values[:, 1]), single)[1:]
    np.testing.assert_array_equal(found[0], [[COMM.size, 2.0 * COMM.size], [3.0, 4.0]])
    np.testing.assert_array_equal(found[1], [2.0 * COMM.size, 4.0])
    np.testing.assert_array_equal(found[2], [1.0, 3.0])


@pytest.mark.ranks(2, 3)
def test_ranks_that_do_not_call_are_named():
    comm, others = COMM.Dup(), ", ".join(map(str, range(1, COMM.size)))
    if comm.rank == 0:
        with pytest.raises(InputError, match=rf"ranks? {others} (is|are) not in gather\(\)"):
            meet(comm, "gather()", patience=0.01)
    # not freed: a later communicator with its number would receive the messages that stay in it


@pytest.mark.ranks(2)
def test_ranks_wait_for_a_late_one(capsys):
    comm, is_late = COMM.Dup(), COMM.rank == 1
    for call, pause in (("save()", 0.0), ("gather()", 0.5), ("to_html()", 0.0)):
        time.sleep(pause if is_late else 0.0)
        meet(comm, call, patience=0.2)
    comm.Free()
    told = capsys.readouterr().err
    assert told == ("" if is_late else "rank 1 is not in gather(): call it on all ranks\n")
