"""Nearly incompressible materials on several ranks: the same counts and solution as on one."""

from mpi4py import MPI

import pytest
from pressed_blocks import pressed_blocks
from sparse_rows import distributed

from fenics_tfeti.feti import Options, TornSolver


def test_as_on_one_rank():
    # the communicator of the system is that of the problem's mesh
    problem = pressed_blocks(MPI.COMM_SELF, 3, 0.49999, subdomain_size=400)
    dealt = distributed(problem.system, MPI.COMM_WORLD)
    reports = [TornSolver(s, Options()).solve().report for s in (dealt, problem.system)]
    assert "stiff modes" in reports[0].preconditioner_reason
    assert reports[0].preconditioner_reason == reports[1].preconditioner_reason
    counts = [report.products["total"] for report in reports]
    assert abs(counts[0] - counts[1]) <= 2
    forces = [report.contacts[0].normal_force for report in reports]
    assert forces[0] == pytest.approx(forces[1], rel=1e-6)
