"""A real SIGINT during a solve leaves the last iterate and a report."""

import os
import signal
import subprocess
import sys
import threading

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from interruptions import InterruptedTimer, interrupt_after
from sparse_rows import distributed
from torn import column

from fenics_tfeti import Deformed, Interrupted, Plane, RigidObstacle
from fenics_tfeti.feti import Options, TornSolver, interruption, save_system

COMM = MPI.COMM_WORLD
COLUMN = distributed(column(height=3), COMM)


def interrupt():
    """Send SIGINT to the last rank alone."""
    if COMM.rank == COMM.size - 1:
        os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def handler():
    """Python's handler is there in each test, and after it; workers of pytest ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler


@pytest.mark.ranks
@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_interrupted_solve(monkeypatch, method):
    """It ends at once on all ranks; solving again goes on and finds the solution."""
    options = Options(rtol=1e-8, method=method)
    exact = TornSolver(COLUMN, options).solve()
    torn = TornSolver(COLUMN, options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, torn.setup.norm.products + 4, interrupt)
        with pytest.raises(Interrupted) as caught:
            torn.solve()
    report, solution = caught.value.report, caught.value.solution
    assert not report.converged and report.reason == "interrupted"
    assert COMM.allgather(report.products) == COMM.size * [report.products]
    assert 0 < report.products["total"] < exact.report.products["total"]
    moved = COMM.allgather(any(u.any() for u in solution.displacements))
    assert any(moved) and report.certificate.worst > 1e-8
    again = torn.solve()
    assert again.report.converged
    np.testing.assert_allclose(again.normal_force, exact.normal_force, rtol=1e-6)
    for found, expected in zip(again.report.contacts, exact.report.contacts, strict=True):
        assert found.normal_force == pytest.approx(expected.normal_force, rel=1e-7)


def test_active_set_method_goes_on_from_its_last_iterate(monkeypatch):
    options = Options(rtol=1e-10)
    whole = TornSolver(column(n=4), options).solve().report.products["total"]
    torn = TornSolver(column(n=4), options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, whole - 2, interrupt)
        with pytest.raises(Interrupted) as caught:
            torn.solve()
    assert caught.value.report.certificate.worst < 1e-3
    assert torn.solve().report.products["total"] < whole


@pytest.mark.ranks
@pytest.mark.parametrize("phase", ["constraints", "factorisation", "deflation"])
def test_set_up_is_interrupted_after_a_phase(phase):
    timer = InterruptedTimer(phase, interrupt)
    with pytest.raises(Interrupted, match="before there was an iterate") as caught:
        TornSolver(COLUMN, timer=timer)
    assert list(timer.seconds)[-1] == phase
    assert caught.value.solution is None and caught.value.report is None


def test_second_signal_is_not_deferred():
    with pytest.raises(KeyboardInterrupt), interruption.deferred():
        interrupt()
        assert interruption.received() and not interruption.agreed()
        interrupt()
        raise AssertionError("not reached")


def test_signal_before_another_error_is_not_lost():
    with pytest.raises(KeyboardInterrupt) as caught, interruption.deferred():
        interrupt()
        raise ValueError("of something else")
    assert isinstance(caught.value.__context__, ValueError)
    assert not interruption.received() and not interruption.agreed()


def test_checks_end_the_block():
    with pytest.raises(Interrupted), interruption.deferred():
        interruption.check(COMM)
        with interruption.deferred():
            interrupt()
        interruption.check(COMM)
    with interruption.deferred():
        interruption.check(COMM)
        assert not interruption.agreed()


def test_handlers_of_others_stay():
    calls = []
    signal.signal(signal.SIGINT, lambda *_: calls.append(1))
    try:
        with interruption.deferred():
            interrupt()
        TornSolver(column()).solve()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert calls == [1]


def test_other_threads_leave_the_handler_alone():
    found = []

    def run():
        found.append(TornSolver(column()).solve().report.converged)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [True]


def test_command_writes_the_last_iterate(tmp_path):
    """SIGINT from another process, as a terminal sends it."""
    save_system(tmp_path / "system.npz", column(n=3))
    code = (
        "import signal, sys, time\n"
        "from itertools import count\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from fenics_tfeti.feti import interruption\n"
        "from fenics_tfeti.feti.dual.operator import DualOperator\n"
        "from fenics_tfeti.feti.__main__ import main\n"
        "apply, number = DualOperator.packed, count(1)\n"
        "def waiting(self, x):\n"
        "    print('product', flush=True)\n"
        "    fifth = next(number) == 5\n"
        "    while fifth and not interruption.received():\n"
        "        time.sleep(0.01)\n"
        "    return apply(self, x)\n"
        "DualOperator.packed = waiting\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    files = ["--report", str(tmp_path / "r.json"), "--solution", str(tmp_path / "s.npz")]
    command = [sys.executable, "-c", code, str(tmp_path / "system.npz"), "--rtol", "1e-12", *files]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        lines = [process.stdout.readline() for _ in range(5)]
        assert lines == 5 * ["product\n"]
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        assert process.wait(timeout=100) == 130
    assert "interrupted" in rest and rest.count("product\n") <= 4
    assert '"reason": "interrupted"' in (tmp_path / "r.json").read_text()
    assert np.load(tmp_path / "s.npz")["displacement"].shape[1] == 3


@pytest.mark.ranks(2)
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


@pytest.mark.ranks(2)
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
    problem = scene.problem(contacts=contacts, gaps=Deformed())
    with pytest.raises(Interrupted) as caught:
        problem.solve(monitor=solved.append)
    assert caught.value.report is problem.report and problem.report.converged
    assert len(problem.report.passes) == 1
    uh = caught.value.solution.copy()
    np.testing.assert_allclose(uh.x.array, problem.solve().x.array, rtol=0.0, atol=1e-12)
