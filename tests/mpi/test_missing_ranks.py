"""Functions for all ranks that rank 0 alone calls, which would wait for ever."""

from mpi4py import MPI

import pytest
import scenes

from fenics_tfeti import InputError
from fenics_tfeti.io import (
    contact_fields,
    draw_deformed,
    draw_profile,
    von_mises,
    write_fields,
)

COMM = MPI.COMM_WORLD
# Messages to ranks that do not call stay in the communicator: were it freed, a later one with its
# number would receive them.
KEPT = []

CALLS = {
    "gather()": lambda problem, folder: problem.results[0].gather(),
    "to_json()": lambda problem, folder: problem.report.to_json(folder / "a.json"),
    "to_html()": lambda problem, folder: problem.report.to_html(folder / "a.html", problem.u),
    "save()": lambda problem, folder: problem.save(folder / "a.npz"),
    "write_fields()": lambda problem, folder: write_fields(folder / "a.pvd", problem.u),
    "draw_deformed()": lambda problem, folder: draw_deformed(folder / "a.png", problem.u),
    "contact_fields()": lambda problem, folder: contact_fields(problem.space, problem.results),
    "von_mises()": lambda problem, folder: von_mises(problem.space.mesh, None),
}


@pytest.mark.parametrize("call", CALLS)
def test_missing_rank_is_named(call, tmp_path, monkeypatch):
    monkeypatch.setenv("FENICS_TFETI_PATIENCE", "0.01")
    problem = scenes.two_beams(COMM, "quadrilateral", 2).problem()
    KEPT.append(problem.space.mesh)
    problem.solve()
    if COMM.rank == 0:
        with pytest.raises(InputError) as told:
            CALLS[call](problem, tmp_path)
        assert str(told.value) == f"rank 1 is not in {call}: call it on all ranks"


def test_missing_rank_of_curves_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("FENICS_TFETI_PATIENCE", "0.01")
    comm = COMM.Dup()
    if comm.rank == 0:
        with pytest.raises(InputError, match=r"rank 1 is not in draw_profile\(\)"):
            draw_profile(tmp_path / "a.png", {}, "x", "y", comm=comm)
