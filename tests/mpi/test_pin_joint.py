"""The joint of fork, lug and pin on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest
from joints import axial_motion, joint_problem, read_joint


@pytest.mark.parametrize(
    ("exchange", "degree"),
    [(False, 1), (True, 1), pytest.param(True, 2, marks=pytest.mark.heavy)],
    ids=["holes", "pin", "pin, degree 2"],
)
def test_motions_and_pressures_are_those_of_one_rank(exchange, degree):
    outcomes = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        meshes = read_joint(2.5, degree, comm)
        problem = joint_problem(meshes, degree, exchange, initial_gap=0.02)
        motion = axial_motion(meshes, problem.solve())
        assert max(map(abs, motion.values())) < 0.1
        report, contacts = problem.report, [contact.gather() for contact in problem.results]
        assert len(report.free_motions) == 2
        assert all("translation along (0, 0, 1)" in motion for motion in report.free_motions)
        outcomes.append(
            [len(report.weak_motions), *(contact.pressure.max() for contact in contacts)]
        )
    assert outcomes[0] == pytest.approx(outcomes[1], rel=1e-3)


def test_sizes_of_clearance_and_deviation_are_the_same():
    entries = [
        joint_problem(read_joint(2.5, 1, comm), 1)._undeformed.pairings[0].summary
        for comm in (MPI.COMM_WORLD, MPI.COMM_SELF)
    ]
    for key in ("pairs", "deviation", "blurred", "mean_gap"):
        assert entries[0][key] == pytest.approx(entries[1][key], rel=1e-9)
