"""Files that cannot be written are the same error on all ranks, and nothing is left behind."""

import json
import resource
import signal
from pathlib import Path

from mpi4py import MPI

import pytest
import scenes

from fenics_tfeti.feti import save_system
from fenics_tfeti.io import draw_profile, write_fields

comm = MPI.COMM_WORLD

WRITERS = {
    "result.pvd": lambda path, problem, uh: write_fields(path, uh),
    "curve.png": lambda path, problem, uh: draw_profile(path, {"x": ([0, 1], [0, 1])}, "x", "y"),
    "report.json": lambda path, problem, uh: problem.report.to_json(path),
    "page.html": lambda path, problem, uh: problem.report.to_html(path, uh),
    "system.npz": lambda path, problem, uh: save_system(path, problem.system),
    "checkpoint.npz": lambda path, problem, uh: problem.solve(checkpoint=path),
}


def solution(on):
    problem = scenes.pressed_block(on, "quadrilateral").problem()
    return problem, problem.solve()


@pytest.fixture(scope="module")
def solved():
    """Return a problem of all ranks and its solution."""
    return solution(comm)


def unwritable(shared_folder, name):
    """Return paths at which no file can be, also not for an administrator."""
    if comm.rank == 0:
        (shared_folder / "file").touch()
    comm.barrier()
    return [shared_folder / "file" / name, Path("/proc") / name]


@pytest.fixture
def full_disk():
    """Let no file of this process grow beyond 50 bytes; the writer of dolfinx says nothing."""
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(number):
        resource.setrlimit(resource.RLIMIT_FSIZE, (number, hard))

    yield lambda: fill(50)
    fill(soft)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("name", WRITERS)
def test_file_that_cannot_be_written(shared_folder, name, solved):
    for path in unwritable(shared_folder, name):
        with pytest.raises(OSError, match=str(path.parent)):
            WRITERS[name](path, *solved)
    comm.barrier()
    assert sorted(p.name for p in shared_folder.iterdir()) == ["file"]


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_leaves_the_old_file(shared_folder, name, solved, full_disk):
    if comm.rank == 0:
        (shared_folder / name).write_text("old")
    comm.barrier()
    full_disk()
    with pytest.raises(OSError, match="cannot be written") as raised:
        WRITERS[name](shared_folder / name, *solved)
    assert raised.value.filename == str(shared_folder / name)
    comm.barrier()
    assert [p.name for p in shared_folder.iterdir()] == [name]
    assert (shared_folder / name).read_text() == "old"


@pytest.mark.parametrize("name", ["result.pvd", "curve.png"])
def test_full_disk_leaves_no_new_folders(shared_folder, name, solved, full_disk):
    full_disk()
    with pytest.raises(OSError, match="cannot be written"):
        WRITERS[name](shared_folder / "new" / "folder" / name, *solved)
    comm.barrier()
    assert list(shared_folder.iterdir()) == []


def test_one_rank_without_space(shared_folder, solved, full_disk):
    if comm.rank == comm.size - 1:
        full_disk()
    with pytest.raises(OSError, match="is the disk full"):
        write_fields(shared_folder / "result.pvd", [solved[1]])
    comm.barrier()
    assert list(shared_folder.iterdir()) == []


def test_fields_at_the_place_of_a_folder(shared_folder, solved):
    if comm.rank == 0:
        (shared_folder / "result.pvd").mkdir()
    with pytest.raises(OSError, match=r"result.pvd is a folder"):
        write_fields(shared_folder / "result.pvd", solved[1])
    comm.barrier()
    assert [p.name for p in shared_folder.iterdir()] == ["result.pvd"]


@pytest.mark.ranks(2, 3)
def test_only_whole_files_are_left(shared_folder, solved):
    problem, uh = solved
    write_fields(shared_folder / "new" / "result.pvd", [uh])
    problem.report.to_json(shared_folder / "report.json")
    comm.barrier()
    names = {p.name for p in (shared_folder / "new").iterdir()}
    assert {"result.pvd", "result000000.pvtu"} <= names
    assert len(names) == 2 + comm.size
    assert json.loads((shared_folder / "report.json").read_text())["ranks"] == comm.size
    assert sorted(p.name for p in shared_folder.iterdir()) == ["new", "report.json"]


def test_problems_on_one_rank_each_write_their_reports(shared_folder):
    problem, _ = solution(MPI.COMM_SELF)
    path = shared_folder / f"report{comm.rank}.json"
    problem.report.to_json(path)
    assert json.loads(path.read_text())["ranks"] == 1
