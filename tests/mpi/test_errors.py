"""A mistake is the same error on all ranks: none is left waiting."""

from __future__ import annotations

import re

from mpi4py import MPI

import pytest
from mistakes import MISTAKES
from scenes import two_beams

import fenics_tfeti

comm = MPI.COMM_WORLD


@pytest.mark.skipif(comm.size == 1, reason="tests/test_errors.py makes them on one rank")
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.name)
def test_every_rank_raises_the_same(mistake):
    with pytest.raises(fenics_tfeti.ContactError) as raised:
        mistake.pose(comm)
    assert type(raised.value) is mistake.error
    message = str(raised.value)
    for words in mistake.words:
        assert re.search(words, message), f"{words!r} is not in: {message}"
    assert comm.allgather(message) == comm.size * [message]


def test_ranks_are_in_step_after_an_error():
    problem = two_beams(comm, "quadrilateral", 4).problem()
    problem.solve()
    assert problem.report.converged


def test_not_converged():
    problem = two_beams(comm, "quadrilateral", 6).problem(
        options={"smalbe_max_it": 1, "method": "smalbe", "rtol": 1e-10, "subdomain_size": 100}
    )
    with pytest.raises(fenics_tfeti.NotConverged, match="smalbe_max_it"):
        problem.solve()
