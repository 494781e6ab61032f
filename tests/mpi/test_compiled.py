"""All ranks of a node take the code that one of them compiles."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from mpi4py import MPI

import pytest

from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.factors.compiled import supernodal_library

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.skipif("cholmod" not in available_packages(), reason="no CHOLMOD")


@pytest.fixture
def folder():
    """Return an empty folder that all ranks know."""
    path = COMM.bcast(tempfile.mkdtemp() if COMM.rank == 0 else None)
    yield Path(path)
    COMM.barrier()
    if COMM.rank == 0:
        shutil.rmtree(path)


def test_one_rank_compiles(folder, monkeypatch):
    present, reason = supernodal_library()
    assert present is not None, reason
    compiler = folder / "compiler"
    if COMM.rank == 0:
        copy = f'for output; do before=$last; last=$output; done; cp {present._name} "$before"'
        compiler.write_text(f"#!/bin/sh\necho run >> {folder}/runs\n{copy}\n")
        compiler.chmod(0o755)
    COMM.barrier()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    monkeypatch.setenv("CC", str(compiler))
    supernodal_library.cache_clear()
    try:
        library, reason = supernodal_library()
    finally:
        supernodal_library.cache_clear()
    assert library is not None, reason
    COMM.barrier()
    assert (folder / "runs").read_text() == "run\n"
