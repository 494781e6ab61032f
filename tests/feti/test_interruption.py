"""A real SIGINT during a solve leaves the last iterate and a report."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

from mpi4py import MPI

import numpy as np
import pytest
from interruptions import InterruptedTimer, interrupt_after
from torn import column

from fenics_tfeti import Interrupted
from fenics_tfeti.feti import Options, TornSolver, interruption, save_system

COMM = MPI.COMM_SELF


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(autouse=True)
def handler():
    """Python's handler is there in each test, and after it; workers of pytest ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler


@pytest.mark.parametrize("method", ["active_set", "smalbe"])
def test_interrupted_solve(monkeypatch, method):
    """It ends at once; solving again goes on and finds the solution."""
    options = Options(rtol=1e-8, method=method)
    exact = TornSolver(column(), options).solve()
    torn = TornSolver(column(), options)
    with monkeypatch.context() as patch:
        interrupt_after(patch, torn.setup.norm.products + 4, interrupt)
        with pytest.raises(Interrupted) as caught:
            torn.solve()
    report, solution = caught.value.report, caught.value.solution
    assert not report.converged and report.reason == "interrupted"
    assert 0 < report.products["total"] < exact.report.products["total"]
    assert solution.displacements[2].any() and report.certificate.worst > 1e-8
    again = torn.solve()
    assert again.report.converged
    np.testing.assert_allclose(again.normal_force, exact.normal_force, rtol=1e-6)


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


@pytest.mark.parametrize("phase", ["constraints", "factorisation", "deflation"])
def test_set_up_is_interrupted_after_a_phase(phase):
    timer = InterruptedTimer(phase, interrupt)
    with pytest.raises(Interrupted, match="before there was an iterate") as caught:
        TornSolver(column(), timer=timer)
    assert list(timer.seconds)[-1] == phase
    assert caught.value.solution is None and caught.value.report is None


def test_second_signal_is_not_deferred():
    with pytest.raises(KeyboardInterrupt), interruption.deferred():
        interrupt()
        assert interruption.received() and not interruption.agreed()
        interrupt()
        raise AssertionError("not reached")


def test_signal_that_no_check_has_seen_is_not_lost():
    with pytest.raises(KeyboardInterrupt), interruption.deferred():
        interrupt()


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
