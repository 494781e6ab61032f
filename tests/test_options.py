"""Options from the command line, and scripts that have none: run inside other programs."""

from __future__ import annotations

import pytest
from new_process import run_python

SOLVE = """
from mpi4py import MPI
from scenes import two_beams
problem = two_beams(MPI.COMM_SELF, "quadrilateral", 2).problem(options={"rtol": 1e-5})
problem.solve()
print(problem.report.converged, problem.options.solver.rtol, problem.options.solver.smalbe_rho)
"""


@pytest.mark.parametrize("change", ["sys.argv = []", "del sys.argv", "sys.argv = ['']"])
def test_script_without_a_command_line(change):
    """Programs that embed Python may have none; dolfinx 0.5 itself wants one at its import."""
    assert run_python(f"import sys, mpi4py.MPI, dolfinx; {change}\n{SOLVE}") == "True 1e-05 1.0"


def test_arguments_that_are_not_ours_are_left_alone():
    assert run_python(SOLVE, "-n", "4", "--rtol", "2") == "True 1e-05 1.0"


def test_command_line_comes_before_the_script():
    assert run_python(SOLVE, "-tfeti_rtol", "1e-4", "-tfeti_smalbe_rho", "2") == "True 0.0001 2.0"


def test_modules_that_were_started_with_the_command_line_do_not_count_it_twice():
    start = "import sys, mpi4py.MPI, petsc4py; petsc4py.init(['name', *sys.argv[1:]])"
    assert run_python(f"{start}\n{SOLVE}", "-tfeti_rtol", "1e-4") == "True 0.0001 1.0"


def test_flags_without_values_print_what_they_say():
    printed = run_python(SOLVE, "-tfeti_monitor", "-tfeti_rtol", "1e-4", "-tfeti_view")
    lines = printed.splitlines()
    assert lines[0].startswith("face    0  products")
    assert lines[-1] == "True 0.0001 1.0"
    for words in ("discretisation", "rows active", "force on slave", "result  converged"):
        assert words in printed


def test_nothing_is_printed_unasked():
    assert run_python(SOLVE) == "True 1e-05 1.0"
    assert run_python(SOLVE, "-tfeti_monitor", "false", "-tfeti_view", "0") == "True 1e-05 1.0"
