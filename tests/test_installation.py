"""``python -m fenics_tfeti``: facts of the installation, and the verdict."""

from __future__ import annotations

import subprocess
import sys

from mpi4py import MPI

import pytest

from fenics_tfeti import installation, self_test
from fenics_tfeti.installation import blas, facts, main
from fenics_tfeti.self_test import SelfTest

COMM = MPI.COMM_SELF


def test_command_prints_the_facts_and_passes():
    command = [sys.executable, "-m", "fenics_tfeti"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert answer.returncode == 0, answer.stderr
    for words in ("dolfinx  ", "PETSc  ", "Gflop/s", "sparse factors  ", "passed: the pressure"):
        assert words in answer.stdout


def test_facts_have_all_names():
    found = facts(COMM)
    assert list(found)[:3] == ["fenics_tfeti", "Python", "dolfinx"]
    assert {"PETSc", "MPI", "NumPy", "SciPy", "BLAS", "sparse factors", "gmsh"} < found.keys()
    assert found["processes"] == "1"
    assert all(value and "\n" not in value for value in found.values())


def test_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    assert facts(COMM)["gmsh"] == "not installed (for mesh files)"


@pytest.mark.parametrize(("rate", "slow"), [(2e9, True), (3e10, False)])
def test_slow_blas_is_told(rate, slow):
    assert ("slow: install OpenBLAS" in blas(rate)) == slow
    assert f"{rate / 1e9:.1f} Gflop/s" in blas(rate)


def test_reference_blas_is_named_where_there_is_no_other(monkeypatch):
    monkeypatch.setattr(installation, "_loaded_libraries", lambda: ["libblas.so.3", "libm.so.6"])
    assert blas(2e9).startswith("reference BLAS, ")
    monkeypatch.setattr(installation, "_loaded_libraries", lambda: [])
    assert blas(2e9).startswith("unknown library, ")


def test_wrong_pressures_are_a_failure(monkeypatch, capsys):
    monkeypatch.setattr(self_test, "self_test", lambda comm: SelfTest(0.3, 7, 1.0))
    assert main(COMM) == 1
    assert "FAILED: the pressure is exact to 3.0e-01" in capsys.readouterr().out


def test_without_dolfinx_there_is_no_self_test(monkeypatch, capsys):
    monkeypatch.setattr(installation, "_dolfinx", lambda: "cannot be imported (x)")
    assert main(COMM) == 1
    assert "self-test" not in capsys.readouterr().out
