"""SIGINT to one rank ends the solve on all of them, in the same iteration."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from interruptions import interrupt_after
from torn import column

from fenics_tfeti import Interrupted
from fenics_tfeti.feti import ContactRows, Options, TornSolver, solver
from fenics_tfeti.feti.solution.setup import factor_subdomains

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1


def interrupt():
    """Send SIGINT to the last rank alone."""
    if COMM.rank == LAST:
        os.kill(os.getpid(), signal.SIGINT)


def distributed():
    """Return the column with its subdomains on the ranks in turn."""
    whole = column(height=3)
    return replace(
        whole,
        subdomains=whole.subdomains[COMM.rank :: COMM.size],
        contacts=whole.contacts if COMM.rank == 0 else ContactRows.none(3),
        comm=COMM,
    )


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_one_rank_is_interrupted(monkeypatch, method):
    options = Options(rtol=1e-8, method=method)
    exact = TornSolver(distributed(), options).solve().report
    torn = TornSolver(distributed(), options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, torn.setup.norm.products + 5, interrupt)
        with pytest.raises(Interrupted) as caught:
            torn.solve()
    report = caught.value.report
    assert report.reason == "interrupted" and not report.converged
    assert COMM.allgather(report.products) == COMM.size * [report.products]
    assert report.products["total"] < exact.products["total"]
    again = torn.solve().report
    assert again.contact_force == pytest.approx(exact.contact_force, rel=1e-7)


def test_set_up_of_one_rank_is_interrupted(monkeypatch):
    def factor(*arguments):
        interrupt()
        return factor_subdomains(*arguments)

    monkeypatch.setattr(solver, "factor_subdomains", factor)
    with pytest.raises(Interrupted) as caught:
        TornSolver(distributed())
    assert caught.value.solution is None


def test_interrupted_problem_goes_on(monkeypatch):
    scene = scenes.two_beams(COMM, "hexahedron", 2)
    exact = scene.problem(options={"rtol": 1e-9})
    exact.solve()
    problem = scene.problem(options={"rtol": 1e-9})
    with monkeypatch.context() as patch:
        interrupt_after(patch, 8, interrupt)
        with pytest.raises(Interrupted) as caught:
            problem.solve()
    assert caught.value.report is problem.report and not problem.report.converged
    uh = caught.value.solution
    assert COMM.allreduce(float(np.abs(uh.x.array).max(initial=0.0)), MPI.MAX) > 0.0
    problem.solve()
    assert problem.report.converged
    assert problem.report.energy == pytest.approx(exact.report.energy, rel=1e-8)


def test_signal_after_the_solution(monkeypatch):
    """Such as during the passes of exact non-penetration: the solution is with the error."""
    problem = scenes.pressed_block(COMM, "quadrilateral").problem()
    take = problem._take

    def interrupted(*arguments):
        interrupt()
        return take(*arguments)

    monkeypatch.setattr(problem, "_take", interrupted)
    with pytest.raises(Interrupted) as caught:
        problem.solve()
    assert caught.value.report.converged
    assert caught.value.solution is problem._displacement
