"""Files that cannot be written are the same error on all ranks, and nothing is left behind."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path

from mpi4py import MPI

import pytest
import scenes

from fenics_tfeti.io import write_fields

comm = MPI.COMM_WORLD


@pytest.fixture
def folder():
    """Return an empty folder that all ranks share."""
    path = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None))
    yield path
    comm.barrier()
    if comm.rank == 0:
        shutil.rmtree(path)


def solved(on=comm):
    problem = scenes.pressed_block(on, "quadrilateral").problem()
    return problem, problem.solve()


def unwritable(folder, name):
    """Return paths at which no file can be, also not for an administrator."""
    if comm.rank == 0:
        (folder / "file").touch()
    comm.barrier()
    return [folder / "file" / name, Path("/proc") / name]


def test_report_that_cannot_be_written(folder):
    problem, _ = solved()
    for path in [*unwritable(folder, "report.json"), folder / "missing" / "report.json"]:
        with pytest.raises(OSError, match=str(path)):
            problem.report.to_json(path)
    comm.barrier()
    assert sorted(p.name for p in folder.iterdir()) == ["file"]


def test_fields_that_cannot_be_written(folder):
    _, uh = solved()
    for path in unwritable(folder, "result.pvd"):
        with pytest.raises(OSError, match=str(path)):
            write_fields(path, [uh])
    comm.barrier()
    assert sorted(p.name for p in folder.iterdir()) == ["file"]


def test_only_whole_files_are_left(folder):
    problem, uh = solved()
    write_fields(folder / "new" / "result.pvd", [uh])
    problem.report.to_json(folder / "report.json")
    comm.barrier()
    names = {p.name for p in (folder / "new").iterdir()}
    assert {"result.pvd", "result000000.pvtu"} <= names
    assert len(names) == 2 + comm.size
    assert json.loads((folder / "report.json").read_text())["ranks"] == comm.size
    assert sorted(p.name for p in folder.iterdir()) == ["new", "report.json"]


def test_problems_on_one_rank_each_write_their_reports(folder):
    problem, _ = solved(MPI.COMM_SELF)
    path = folder / f"report{comm.rank}.json"
    problem.report.to_json(path)
    assert json.loads(path.read_text())["ranks"] == 1
