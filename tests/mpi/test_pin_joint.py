"""The joint of fork, lug and pin on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest
from joints import joint_problem, read_joint


@pytest.mark.parametrize("exchange", [False, True], ids=["holes", "pin"])
def test_weak_motions_and_pressures_are_those_of_one_rank(exchange):
    outcomes = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        problem = joint_problem(read_joint(2.5, 1, comm), 1, exchange, initial_gap=0.02)
        problem.solve()
        contacts = [contact.gather() for contact in problem.contact]
        outcomes.append(
            [
                len(problem.report.weak_motions),
                *(contact.pressure.max() for contact in contacts),
            ]
        )
    assert outcomes[0] == pytest.approx(outcomes[1], rel=1e-3)


def test_sizes_of_clearance_and_deviation_are_the_same():
    entries = [
        joint_problem(read_joint(2.5, 1, comm), 1)._matched[0].summary
        for comm in (MPI.COMM_WORLD, MPI.COMM_SELF)
    ]
    for key in ("pairs", "deviation", "blurred", "mean_gap"):
        assert entries[0][key] == pytest.approx(entries[1][key], rel=1e-9)
