"""All ranks of a node take the code that one of them compiles."""

from mpi4py import MPI

import pytest

from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.factors.compiled import supernodal_library

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.skipif("cholmod" not in available_packages(), reason="no CHOLMOD")


def test_one_rank_compiles(shared_folder, monkeypatch):
    present, reason = supernodal_library()
    assert present is not None, reason
    compiler = shared_folder / "compiler"
    if COMM.rank == 0:
        copy = f'for output; do before=$last; last=$output; done; cp {present._name} "$before"'
        compiler.write_text(f"#!/bin/sh\necho run >> {shared_folder}/runs\n{copy}\n")
        compiler.chmod(0o755)
    COMM.barrier()
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared_folder))
    monkeypatch.setenv("CC", str(compiler))
    supernodal_library.cache_clear()
    try:
        library, reason = supernodal_library()
    finally:
        supernodal_library.cache_clear()
    assert library is not None, reason
    COMM.barrier()
    assert (shared_folder / "runs").read_text() == "run\n"
