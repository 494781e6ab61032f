"""What a solve tells: to the user's function and the log; it prints nothing unless asked."""

import logging

from mpi4py import MPI

import pytest
from sparse_rows import distributed
from torn import column

from fenics_tfeti.feti import ActiveSetStep, Options, TornSolver
from fenics_tfeti.feti.solution.monitor import describe_step
from fenics_tfeti.qp import OuterIteration

pytestmark = pytest.mark.once


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_function_gets_the_steps_of_the_report(method):
    steps = []
    report = TornSolver(column(), Options(method=method)).solve(steps.append).report
    if method == "smalbe":
        assert steps == report.history and isinstance(steps[0], OuterIteration)
    else:
        assert steps == report.faces and isinstance(steps[0], ActiveSetStep)
    assert len(steps) > 1 or method == "active_set"


def test_option_prints_a_line_for_each_step_and_the_log_has_the_same(capfd, caplog):
    """Nothing is printed unasked."""
    TornSolver(column()).solve()
    assert capfd.readouterr() == ("", "")
    steps = []
    with caplog.at_level(logging.INFO, logger="fenics_tfeti"):
        TornSolver(column(), Options(print_progress=True, method="smalbe")).solve(steps.append)
    lines = capfd.readouterr().out.splitlines()
    assert lines == [describe_step(step, number) for number, step in enumerate(steps)]
    assert lines == [record.message for record in caplog.records]
    assert lines[-1].startswith(f"outer {len(steps) - 1:3d}  products")


def test_error_of_the_function_is_the_users_own():
    def fail(step):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        TornSolver(column()).solve(fail)


@pytest.mark.ranks(2)
def test_error_of_a_function_on_one_rank_is_one_on_all():
    """Also where the others have no function."""
    comm = MPI.COMM_WORLD

    def fail(step):
        raise ValueError("enough")

    for function in (lambda step: comm.rank and fail(step), fail if comm.rank else None):
        with pytest.raises(ValueError, match="enough"):
            TornSolver(distributed(column(), comm)).solve(function)
