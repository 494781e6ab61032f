"""The warning of large displacement gradients: on rank 0, for the bodies of all ranks."""

from __future__ import annotations

import warnings

from mpi4py import MPI

from scenes import YOUNG, two_beams

COMM = MPI.COMM_WORLD


def told(comm):
    """Return the messages of a problem with E in MPa, lengths in metres and loads in N."""
    scene = two_beams(comm, "quadrilateral", 6)
    scene.kept[0].value = 1e-6 * YOUNG
    problem = scene.problem(options={"rtol": 1e-8})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.solve()
    return [str(warning.message) for warning in caught]


def test_rank_0_warns_as_one_rank_alone_does():
    alone, together = told(MPI.COMM_SELF), told(COMM)
    assert len(alone) == 1
    assert together == (alone if COMM.rank == 0 else [])
