"""Options from the command line, and scripts that have none: run inside other programs."""

import inspect

import pytest
from new_process import run_python

from fenics_tfeti import ContactProblem, InputError, NonlinearContactProblem
from fenics_tfeti.feti import Options
from fenics_tfeti.options import NewtonOptions, contact_options

SOLVE = """
from mpi4py import MPI
from scenes import two_beams
problem = two_beams(MPI.COMM_SELF, "quadrilateral", 2).problem(options={"rtol": 1e-5})
problem.solve()
print(problem.report.converged, problem.options.solver.rtol, problem.options.solver.smalbe_rho)
"""


def test_script_without_a_command_line():
    """Programs that embed Python may have none; dolfinx 0.5 itself wants one at its import."""
    code = "import sys, mpi4py.MPI, dolfinx\n"
    for change in ("sys.argv = []", "sys.argv = ['']", "del sys.argv"):
        code += f"{change}\n{SOLVE}"
    assert run_python(code).splitlines() == 3 * ["True 1e-05 1.0"]


@pytest.mark.once
def test_arguments_that_are_not_ours_are_left_alone_and_nothing_is_printed_unasked():
    arguments = ("-n", "4", "--rtol", "2", "-tfeti_print_progress", "false", "-tfeti_view", "0")
    assert run_python(SOLVE, *arguments) == "True 1e-05 1.0"


def test_modules_that_were_started_with_the_command_line_do_not_count_it_twice():
    start = "import sys, mpi4py.MPI, petsc4py; petsc4py.init(['name', *sys.argv[1:]])"
    assert run_python(f"{start}\n{SOLVE}", "-tfeti_rtol", "1e-4") == "True 0.0001 1.0"


@pytest.mark.once
def test_command_line_comes_before_the_script_and_flags_print_what_they_say():
    arguments = (
        "-tfeti_print_progress",
        "-tfeti_rtol",
        "1e-4",
        "-tfeti_view",
        "-tfeti_smalbe_rho",
        "2",
    )
    printed = run_python(SOLVE, *arguments)
    lines = printed.splitlines()
    assert lines[0].startswith("face    0  products")
    assert lines[-1] == "True 0.0001 2.0"
    for words in ("discretisation", "conditions active", "force of", "result  converged"):
        assert words in printed


def test_accuracy_of_linearised_problems_by_default():
    """Whether the options are made from a dictionary or not."""
    assert NewtonOptions().solver.rtol == 1e-3
    assert contact_options(NewtonOptions, {"newton_max_it": 7}, "none_") == NewtonOptions(
        newton_max_it=7
    )
    assert contact_options(NewtonOptions, {"rtol": 1e-5}, "none_").solver == Options(rtol=1e-5)


@pytest.mark.parametrize("problem", [ContactProblem, NonlinearContactProblem])
def test_arguments_of_a_solve_have_names(problem):
    """The first one of `ContactProblem` is not that of `NonlinearContactProblem`."""
    _, *arguments = inspect.signature(problem.solve).parameters.values()
    assert {argument.kind for argument in arguments} == {inspect.Parameter.KEYWORD_ONLY}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"smalbe_eta": 1.5}, "'smalbe_eta' is 1.5, it has to be above 0 and at most 1"),
        ({"rtol": 1.0}, "'rtol' is 1.0, it has to be above 0 and below 1"),
        ({"max_products": 0}, "'max_products' is 0, it has to be above 0"),
    ],
)
def test_range_of_a_number(options, message):
    with pytest.raises(InputError, match=f"{message}$"):
        Options(**options)
    assert Options(smalbe_eta=1.0).smalbe_eta == 1.0
