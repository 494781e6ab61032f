"""Pytest plugin for runs under mpirun: all ranks agree on the outcome of every test.

A test that fails on one rank only leaves the others waiting in a collective call, and makes their
summaries say that it passed. Here the ranks exchange the outcome of every phase (setup, call,
teardown). When they differ, the test fails on all ranks; when a rank has failed and the others do
not come, they hang, and the failed rank aborts the run. Only rank 0 writes the report of pytest;
from the others come only the failures, marked with the rank.

Use: ``mpirun -n 2 python -m pytest -p pytest_ranks tests/mpi`` with this folder on PYTHONPATH.
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator

from mpi4py import MPI

import pytest

GRACE = float(os.environ.get("PYTEST_RANKS_GRACE", "20"))  # seconds to wait after a failure
OUTCOMES = ("passed", "skipped", "failed")

comm = MPI.COMM_WORLD.Dup()
stderr = os.dup(2)  # kept for the failures: pytest catches what is written to 2
if comm.rank > 0:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def complain(text: str) -> None:
    """Write text to the terminal, every line marked with the rank."""
    lines = "".join(f"[rank {comm.rank}] {line}\n" for line in text.splitlines())
    os.write(stderr, lines.encode())


def agree(outcome: str, text: str) -> list[str]:
    """Return the outcomes of all ranks; abort if this one has failed and the others hang."""
    mine, all_ = bytearray([OUTCOMES.index(outcome)]), bytearray(comm.size)
    request = comm.Iallgather([mine, MPI.BYTE], [all_, MPI.BYTE])
    start = time.monotonic()
    while not request.Test():
        if outcome == "failed" and time.monotonic() - start > GRACE:
            complain(f"{text}\nfailed here, and another rank has not come in {GRACE:g} s: abort")
            MPI.COMM_WORLD.Abort(1)
        time.sleep(0.001)
    if comm.rank > 0 and outcome == "failed":
        complain(text)
    return [OUTCOMES[i] for i in all_]


errors: list[str] = []


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Keep what went wrong when a file was imported."""
    if report.failed:
        errors.append(report.longreprtext)


def pytest_collection_finish() -> None:
    """Stop on all ranks when the tests of one could not be collected."""
    outcomes = agree("failed" if errors else "passed", "\n".join(errors))
    if "failed" in outcomes and not errors:
        pytest.exit(f"collecting the tests, by rank: {', '.join(outcomes)}", returncode=1)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Make the report say "failed" on all ranks when the outcomes differ."""
    report = yield
    outcomes = agree(report.outcome, f"{report.nodeid} ({report.when})\n{report.longreprtext}")
    if len(set(outcomes)) > 1 and report.outcome != "failed":
        report.outcome = "failed"
        report.longrepr = f"{report.when} by rank: {', '.join(outcomes)}"
        if hasattr(report, "wasxfail"):
            del report.wasxfail
    return report
