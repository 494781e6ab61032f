"""SIGINT to one rank ends the solve on all of them, in the same iteration."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from interruptions import InterruptedTimer, interrupt_after
from torn import column

from fenics_tfeti import Interrupted, Plane, RigidObstacle
from fenics_tfeti.feti import ContactRows, Options, TornSolver

COMM = MPI.COMM_WORLD
LAST = COMM.size - 1


@pytest.fixture(autouse=True)
def handler_of_python():
    """Gmsh, with which other tests make meshes, leaves a handler that ends the process."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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
    assert [c.normal_force for c in again.contacts] == pytest.approx(
        [c.normal_force for c in exact.contacts], rel=1e-7
    )


def test_set_up_of_one_rank_is_interrupted():
    with pytest.raises(Interrupted) as caught:
        TornSolver(distributed(), timer=InterruptedTimer("factorisation", interrupt))
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


def test_signal_after_the_solution():
    """While ranks with contact measure the deformed surfaces: the solution is with the error."""
    scene = scenes.pressed_block(COMM, "quadrilateral")
    plane, solved = Plane((0.0, 0.0), (0.0, 1.0)), []

    def obstacle(x):
        if solved:
            solved.clear()
            os.kill(os.getpid(), signal.SIGINT)
        return plane(x)

    contacts = [RigidObstacle(scene.facet_tags, scenes.GROUND, obstacle)]
    problem = scene.problem(contacts=contacts, options={"non_penetration": "exact"})
    with pytest.raises(Interrupted) as caught:
        problem.solve(monitor=solved.append)
    assert caught.value.report is problem.report and problem.report.converged
    assert len(problem.report.passes) == 1
    uh = caught.value.solution.copy()
    np.testing.assert_allclose(uh.x.array, problem.solve().x.array, rtol=0.0, atol=1e-12)
