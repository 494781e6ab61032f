"""Torn systems in files, on several ranks."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from torn import column

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    TornSolver,
    load_system,
    save_system,
)
from fenics_tfeti.feti.__main__ import main

COMM = MPI.COMM_WORLD


@pytest.fixture
def folder():
    """Return an empty folder that all ranks share."""
    path = Path(COMM.bcast(tempfile.mkdtemp() if COMM.rank == 0 else None))
    yield path
    COMM.barrier()
    if COMM.rank == 0:
        shutil.rmtree(path)


def distributed():
    """Return the column with its subdomains on the ranks in turn, all rows on the last rank."""
    whole, last = column(height=3), COMM.rank == COMM.size - 1
    return replace(
        whole,
        subdomains=whole.subdomains[COMM.rank :: COMM.size],
        contacts=whole.contacts if last else ContactRows.none(3),
        prescribed=whole.prescribed if COMM.rank == 0 else Prescribed(),
        comm=COMM,
    )


def test_file_of_many_ranks_read_by_one_and_by_many(folder):
    exact = TornSolver(column(height=3), Options(rtol=1e-9)).solve().report
    save_system(folder / "system.npz", distributed())
    COMM.barrier()
    for comm in (MPI.COMM_SELF, COMM):
        system = load_system(folder / "system.npz", comm)
        counts = comm.allgather((len(system.subdomains), system.contacts.size))
        assert [sum(count) for count in zip(*counts, strict=True)] == [4, 16]
        assert max(count[0] for count in counts) <= -(-4 // comm.size)
        report = TornSolver(system, Options(rtol=1e-9)).solve().report
        assert [c.normal_force for c in report.contacts] == pytest.approx(
            [c.normal_force for c in exact.contacts], rel=1e-8
        )
        assert report.energy == pytest.approx(exact.energy, rel=1e-8)


def test_errors_reach_all_ranks(folder):
    with pytest.raises(OSError, match="torn system cannot be written"):
        save_system(folder / "missing" / "system.npz", distributed())
    with pytest.raises(FileNotFoundError):
        load_system(folder / "system.npz", COMM)
    # too few subdomains for the last rank to read any: the error is that of another one
    if COMM.rank == 0:
        system = column(n=2, contact=False)
        save_system(folder / "system.npz", replace(system, subdomains=system.subdomains[:1]))
        arrays = dict(np.load(folder / "system.npz"))
        del arrays["subdomains/0/load"]
        np.savez(folder / "system.npz", **arrays)
    COMM.barrier()
    with pytest.raises(InputError, match="'subdomains/0/load' is missing"):
        load_system(folder / "system.npz", COMM)


def test_command(folder, capfd):
    save_system(folder / "system.npz", distributed())
    COMM.barrier()
    command = [str(folder / "system.npz"), "--rtol", "1e-9"]
    assert main([*command, "--solution", str(folder / "solution.npz")], COMM) == 0
    assert main([*command, "--max_products", "1"], COMM) == 1
    assert main([*command, "--method", "none"], COMM) == 2
    COMM.barrier()
    printed = capfd.readouterr()
    assert ("force on slave  (0, 0, 1) of 'joint'" in printed.out) == (COMM.rank == 0)
    assert ("error: option 'method'" in printed.err) == (COMM.rank == 0)
    solution = dict(np.load(folder / "solution.npz"))
    exact = TornSolver(column(height=3), Options(rtol=1e-9)).solve()
    assert solution["normal_force"].sum() == pytest.approx(1.0, rel=1e-8)
    nodes = np.concatenate([s.nodes for s in column(height=3).subdomains])
    u = np.concatenate(exact.displacements).reshape(-1, 3)
    at = np.searchsorted(solution["nodes"], nodes)
    np.testing.assert_array_equal(solution["nodes"][at], nodes)
    size = np.abs(u).max()
    np.testing.assert_allclose(solution["displacement"][at], u, atol=1e-7 * size)
