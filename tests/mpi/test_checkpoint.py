"""Checkpoints of several ranks."""

from mpi4py import MPI

import numpy as np
import pytest
from killed_run import HEIGHTS, Disc, block, block_on_disc, run
from sparse_rows import distributed
from torn import column

from fenics_tfeti import InputError
from fenics_tfeti.feti import TornSolver

COMM = MPI.COMM_WORLD


@pytest.fixture
def path(shared_folder):
    return shared_folder / "checkpoint.npz"


def test_run_goes_on(path):
    mesh = block(COMM, 6)
    whole = list(run(mesh, path))
    COMM.barrier()
    if COMM.rank == 0:
        path.unlink()
    COMM.barrier()
    steps = run(mesh, path)
    first = [next(steps), next(steps)]
    steps.close()
    COMM.barrier()
    for found, expected in zip([*first, *run(mesh, path)], whole, strict=True):
        assert found["step"] == expected["step"]
        assert found["energy"] == pytest.approx(expected["energy"], rel=1e-7, abs=1e-12)
        assert found["force"] == pytest.approx(expected["force"], rel=1e-7, abs=1e-9)


@pytest.mark.parametrize(
    "later", [MPI.COMM_SELF, pytest.param(COMM, marks=pytest.mark.ranks(2, 3))], ids=["one", "all"]
)
def test_run_goes_on_on_other_ranks(path, later):
    """Also on as many ranks, where on three the mesh may be distributed in another way."""
    disc = Disc()
    disc.height = HEIGHTS[-1]
    problem = block_on_disc(block(COMM), disc)
    problem.solve()
    problem.advance()
    problem.save(path)
    again = block_on_disc(block(later), disc)
    assert again.restore(path) == 1
    again.solve()
    assert len(again.report.passes) == 1 < len(problem.report.passes)
    assert again.report.energy == pytest.approx(problem.report.energy, rel=1e-7)


def test_state_on_some_ranks_only_is_refused_on_all(path):
    system = distributed(column(), COMM)
    solver = TornSolver(system)
    solver.solve()
    state = solver.state if COMM.rank else None
    with pytest.raises(InputError, match="start: this rank gives none, others do"):
        TornSolver(system, start=state)


def test_wrong_checkpoints_are_refused_on_all_ranks(path):
    mesh, disc = block(COMM), Disc()
    disc.height = HEIGHTS[-1]
    problem = block_on_disc(mesh, disc)
    problem.solve(checkpoint=path)
    COMM.barrier()
    with pytest.raises(InputError, match="the nodes differ"):
        block_on_disc(block(COMM, 6), disc).restore(path)
    COMM.barrier()
    if COMM.rank == 0:
        arrays = dict(np.load(path))
        # a node of one rank alone is elsewhere
        arrays["coordinates"][-1] += 0.1
        np.savez(path, **arrays)
    COMM.barrier()
    with pytest.raises(InputError, match="the coordinates differ"):
        block_on_disc(mesh, disc).restore(path)
    with pytest.raises(OSError, match="the checkpoint cannot be written"):
        block_on_disc(mesh, disc).solve(checkpoint=path.parent / "missing" / path.name)
