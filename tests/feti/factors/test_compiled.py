"""The compiled code: one compilation for all processes, and PETSc's solves without a compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.feti.factors import compiled
from fenics_tfeti.feti.factors.cholesky import available_packages, describe_package, sparse_cholesky
from fenics_tfeti.feti.factors.compiled import supernodal_library

pytestmark = [
    pytest.mark.once,
    pytest.mark.skipif("cholmod" not in available_packages(), reason="PETSc without CHOLMOD"),
]


COMPILE = (
    "from fenics_tfeti.feti.factors.compiled import supernodal_library\n"
    "library, reason = supernodal_library()\nassert library, reason"
)


@pytest.fixture
def new_cache(tmp_path, monkeypatch):
    """Return the folder of a cache in which nothing is compiled."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    supernodal_library.cache_clear()
    yield tmp_path / "fenics"
    monkeypatch.undo()
    supernodal_library.cache_clear()


def fake_compiler(folder: Path, script: str) -> str:
    """Write a shell script that stands for a compiler; return its path."""
    path = folder / "compiler"
    path.write_text(f"#!/bin/sh\nfor output; do before=$last; last=$output; done\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.fixture
def copy_compiled(request):
    """Return the line of a script that copies the library of this machine to the output."""
    library, reason = supernodal_library()
    assert library is not None, reason
    request.getfixturevalue("new_cache")
    return f'cp {library._name} "$before"'


def test_two_processes_compile_once(copy_compiled, new_cache, tmp_path, monkeypatch):
    script = f"echo run >> {tmp_path}/runs; sleep 0.5; {copy_compiled}"
    monkeypatch.setenv("CC", fake_compiler(tmp_path, script))
    processes = [subprocess.Popen([sys.executable, "-c", COMPILE]) for _ in range(2)]
    assert [process.wait(100) for process in processes] == [0, 0]
    assert (tmp_path / "runs").read_text() == "run\n"
    assert sorted(path.suffix for path in new_cache.iterdir()) == [".lock", ".so"]


@pytest.mark.parametrize(("compiler", "reason"), [
    ("exit 1", "failed: no message"),
    ("echo 'supernodal.c:1: fatal error: no cholmod.h' >&2; exit 1", "fatal error: no cholmod"),
    (None, "does not run"),
])  # fmt: skip
def test_without_a_compiler_petsc_solves(new_cache, tmp_path, monkeypatch, compiler, reason):
    A = sp.diags([2.0, 4.0], format="csr")
    command = "/no/compiler" if compiler is None else fake_compiler(tmp_path, compiler)
    monkeypatch.setenv("CC", command)
    assert reason in describe_package("cholmod")
    assert "solves by PETSc" in describe_package("cholmod")
    factor = sparse_cholesky(A, "cholmod")
    assert factor.between(np.arange(2)) is None
    assert factor.solve(np.array([2.0, 8.0])).tolist() == [1.0, 2.0]
    assert not list(new_cache.glob("*.so"))


def test_killed_compilation_leaves_nothing_that_stops_the_next(
    copy_compiled, new_cache, tmp_path, monkeypatch
):
    """It has written half a file, and held the lock."""
    monkeypatch.setenv("CC", fake_compiler(tmp_path, 'echo half > "$before"; kill -9 $PPID'))
    killed = subprocess.run([sys.executable, "-c", COMPILE], capture_output=True)
    assert killed.returncode == -9
    fake_compiler(tmp_path, copy_compiled)
    library, reason = supernodal_library()
    assert library is not None, reason


def test_folder_that_cannot_be_written_is_a_reason(new_cache, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    library, reason = supernodal_library()
    assert library is None
    assert "file" in reason


def test_declarations_of_another_version_are_a_reason(new_cache, tmp_path, monkeypatch):
    source = tmp_path / "supernodal.c"
    source.write_text("int supernodal_is_usable(void) { return 0; }")
    monkeypatch.setattr(compiled, "SOURCE", source)
    library, reason = supernodal_library()
    assert library is None
    assert reason == "cholmod.h is of another version than the library that PETSc uses"


def test_solves_are_compiled_here():
    """CHOLMOD's declarations come with dolfinx wherever PETSc has CHOLMOD."""
    assert describe_package("cholmod") == "cholmod, compiled solves"
    assert describe_package("mumps") == "mumps"
