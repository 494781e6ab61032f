"""Openings of conditions whose master nodes are on other ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from stepped_blocks import two_blocks

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("upper", [12, 9], ids=["node_to_node", "mortar"])
def test_openings_are_those_of_one_rank(upper):
    problems = [
        two_blocks(0.3, {"rtol": 1e-9}, comm=comm, upper=upper) for comm in (COMM, MPI.COMM_SELF)
    ]
    scale = max(COMM.allgather(np.abs(problems[0].solve().x.array).max()))
    problems[1].solve()
    found, expected = (problem.results[0].gather() for problem in problems)
    order, expected_order = (np.argsort(c.coordinates[:, 0]) for c in (found, expected))
    opening = expected.opening[expected_order]
    assert opening.max() > 1e-3 * scale
    np.testing.assert_allclose(found.opening[order], opening, atol=1e-7 * scale)
