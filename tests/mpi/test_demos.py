"""A demo runs on several ranks, and writes one set of files."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import pytest
from demo_runner import run_demo

comm = MPI.COMM_WORLD


@pytest.mark.skipif(comm.size == 1, reason="tests/demos runs all demos on one rank")
def test_two_beams(tmp_path):
    folder = Path(comm.bcast(str(tmp_path)))
    report = run_demo("two_beams", folder=folder)["report"]
    assert report.ranks == comm.size
    assert report.contact_force == pytest.approx([60e6], rel=1e-6)
    comm.barrier()  # rank 0 removes the folder
