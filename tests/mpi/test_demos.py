"""A demo and the tutorial run on several ranks, and write one set of files."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mpi4py import MPI

import literate
import pytest
from demo_runner import run_demo

comm = MPI.COMM_WORLD


def test_two_beams(tmp_path):
    folder = Path(comm.bcast(str(tmp_path)))
    report = run_demo("two_beams", folder=folder)["report"]
    assert report.ranks == comm.size
    assert [c.normal_force for c in report.contacts] == pytest.approx([60e6], rel=1e-6)
    comm.barrier()  # rank 0 removes the folder


@pytest.mark.heavy
def test_tutorial(tmp_path):
    folder = Path(comm.bcast(str(tmp_path)))
    page = (literate.DOCS / "tutorial.md").read_text()
    variables: dict[str, object] = {}
    with contextlib.chdir(folder):
        exec(compile(literate.script_of(page, "Tutorial"), "<docs>", "exec"), variables)
    comm.barrier()
    files = {path.name for path in (folder / "results").iterdir()}
    assert {"floor.png", "floor.pvd", "block.png", "block_pressure.png"} <= files
    report = variables["problem"].report
    assert report.ranks == comm.size
    assert [c.normal_force for c in report.contacts] == pytest.approx([4921.99], abs=0.01)
    comm.barrier()  # rank 0 removes the folder
