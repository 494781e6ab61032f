"""Steps on any number of ranks are those of one."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from stepped_blocks import CHANGES, new_problem, two_blocks_on_a_floor

from fenics_tfeti import InputError

COMM = MPI.COMM_WORLD


def by_place(problem, uh):
    """Return the displacements of this rank's nodes by place; the bodies are apart."""
    places = np.round(problem.space.tabulate_dof_coordinates()[:, :2], 7) + 0.0
    return dict(zip(map(tuple, places), uh.x.array.reshape(-1, 2), strict=True))


def stepped(comm, change):
    scene = two_blocks_on_a_floor(comm)
    problem = new_problem(scene)
    problem.solve()
    reused = change(scene)
    problem.contacts = list(scene.contacts)
    return problem, problem.solve(), reused


@pytest.mark.parametrize("change", CHANGES)
def test_second_step_is_that_of_one_rank(change):
    problem, uh, reused = stepped(COMM, change)
    alone, expected, _ = stepped(MPI.COMM_SELF, change)
    assert problem.report.reused == reused
    largest = np.abs(expected.x.array).max()
    values = by_place(alone, expected)
    for place, value in by_place(problem, uh).items():
        np.testing.assert_allclose(value, values[place], atol=1e-7 * largest)
    np.testing.assert_allclose(
        [c.normal_force for c in problem.report.contacts],
        [c.normal_force for c in alone.report.contacts],
        rtol=1e-6,
        atol=1e-3,
    )


@pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
def test_nan_on_one_rank_is_raised_on_all():
    scene = two_blocks_on_a_floor(COMM)
    problem = new_problem(scene)
    problem.solve()
    right = float(scene.load.value)
    if COMM.rank == COMM.size - 1:
        scene.load.value = np.nan
    with pytest.raises(InputError, match="NaN"):
        problem.solve()
    scene.load.value = right
    problem.solve()
    assert problem.report.converged
