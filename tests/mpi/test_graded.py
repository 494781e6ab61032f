"""Graded meshes on several ranks: the same choice and solution as on one."""

from mpi4py import MPI

import pytest
from graded_block import graded_block


def test_as_on_one_rank():
    reports = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        problem = graded_block(comm, 2, 30, 1.2, 20.0)
        problem.solve()
        reports.append(problem.report)
    several, single = reports
    assert several.preconditioner_reason == single.preconditioner_reason != ""
    assert min(report.deflation["vectors"] for report in reports) > 0
    assert several.products["total"] <= 1.3 * single.products["total"]
    forces = [report.contacts[0].normal_force for report in reports]
    assert forces[0] == pytest.approx(forces[1], rel=1e-6)
