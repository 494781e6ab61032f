"""Bolts on several ranks are those of one process."""

from mpi4py import MPI

import numpy as np
import pytest
from bolts import flange, preload

COMM = MPI.COMM_WORLD
FORCES = (4e6, 1e6)


def tightened(comm):
    """Return two bolts of which the first is locked while the second one is tightened."""
    scene = flange(2, comm=comm)
    bolts = [preload(scene, k, force=force) for k, force in enumerate(FORCES)]
    problem = scene.problem(
        contacts=[*scene.contacts, *bolts],
        cell_tags=None,
        options={"rtol": 1e-10, "subdomain_size": 300},
    )
    problem.solve()
    problem.contacts[-2] = bolts[0].locked(problem.results[-2])
    problem.contacts[-1] = preload(scene, 1, force=4 * FORCES[1])
    problem.solve()
    return problem


def test_solution_of_one_rank():
    here, alone = tightened(COMM), tightened(MPI.COMM_SELF)
    assert here.results[-1].tension == pytest.approx(4 * FORCES[1], rel=1e-8)
    for found, expected in zip(here.results[-2:], alone.results[-2:], strict=True):
        assert found.shortening == pytest.approx(expected.shortening, rel=1e-7)
        assert found.tension == pytest.approx(expected.tension, rel=1e-7)
    assert np.abs(here.report.load.force).max() < 1e-6 * FORCES[0]
    assert here.report.energy == pytest.approx(alone.report.energy, rel=1e-7)
