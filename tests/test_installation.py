"""``python -m fenics_tfeti``: facts of the installation, and the verdict."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version
from pathlib import Path
from subprocess import CompletedProcess, run

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti import __main__
from fenics_tfeti.__main__ import blas, extra, facts, main, self_test, threads
from fenics_tfeti.errors import ContactError, needs_fenicsx

COMM = MPI.COMM_SELF
ROOT = Path(__file__).parent.parent


def test_command_prints_the_facts_and_passes():
    answer = run_elsewhere(sys.executable, "-m", "fenics_tfeti")
    assert answer.returncode == 0, answer.stderr
    for words in ("dolfinx  ", "PETSc  ", "Gflop/s", "sparse factors  ", "passed: the pressure"):
        assert words in answer.stdout


def test_facts_have_all_names():
    found = facts(COMM)
    assert list(found)[:3] == ["fenics_tfeti", "Python", "dolfinx"]
    assert {"PETSc", "MPI", "NumPy", "SciPy", "BLAS", "sparse factors", "gmsh"} < found.keys()
    assert found["processes"] == "1"
    assert all(value and "\n" not in value for value in found.values())


def test_missing_extra_is_named():
    assert extra("no_such_package", "mesh files") == "not installed (for mesh files)"
    assert extra("numpy", "arrays") == version("numpy")


@pytest.mark.parametrize(
    ("rate", "loaded", "end"),
    [
        (2e9, ["libblas.so.3"], "2.0 Gflop/s (slow: install OpenBLAS, for instance "),
        (2e9, ["libblas.so.3", "libopenblas.so.0"], "2.0 Gflop/s (slow: is the processor busy?)"),
        (3e10, ["libblas.so.3"], "30.0 Gflop/s"),
    ],
)
def test_slow_blas_is_told(rate, loaded, end):
    assert end in blas(rate, loaded)
    assert ("slow" in blas(rate, loaded)) == ("slow" in end)


@pytest.mark.parametrize(
    ("loaded", "name"),
    [
        (["libblas.so.3", "libm.so.6"], "reference BLAS"),
        (["libblas.so.3", "libopenblas.so.0"], "OpenBLAS"),
        ([], "unknown library"),
    ],
)
def test_blas_is_named_by_the_loaded_libraries(loaded, name):
    assert blas(2e9, loaded).startswith(f"{name}, ")


@pytest.mark.ranks
def test_self_test_is_exact():
    """On several ranks it has one result, and so have the facts."""
    comm = MPI.COMM_WORLD
    error, products, seconds = result = self_test(comm)
    assert error < 1e-6 and 0 < products < 100 and seconds > 0.0
    found = facts(comm)
    assert found["processes"] == str(comm.size)
    assert comm.allgather((result, found)) == [(result, found)] * comm.size


@pytest.mark.parametrize(
    ("error", "code", "verdict"),
    [
        (1e-9, 0, "passed: the pressure is exact to 1.0e-09, 7 products with F, 1.0 s"),
        (1e-5, 1, "FAILED: the pressure is exact to 1.0e-05"),
        (np.nan, 1, "FAILED: the pressure is exact to nan"),
    ],
)
def test_verdict(monkeypatch, capsys, error, code, verdict):
    monkeypatch.setattr(__main__, "self_test", lambda comm: (error, 7, 1.0))
    assert main(COMM) == code
    assert verdict in capsys.readouterr().out


def test_error_of_the_solver_is_told(monkeypatch, capsys):
    def failing(comm):
        raise ContactError("no contact")

    monkeypatch.setattr(__main__, "self_test", failing)
    assert main(COMM) == 1
    assert "FAILED: no contact" in capsys.readouterr().out


def run_elsewhere(python: Path | str, *arguments: str, path: Path = ROOT) -> CompletedProcess[str]:
    """Run a Python that finds this package and what is in a folder."""
    environment = os.environ | {"PYTHONPATH": f"{path}{os.pathsep}{ROOT}"}
    command = [str(python), *arguments]
    return run(command, env=environment, capture_output=True, text=True, timeout=100)


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory):
    """Return the Python of an environment without any package."""
    folder = tmp_path_factory.mktemp("bare")
    run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    return folder / "bin" / "python"


@pytest.mark.parametrize(
    ("what", "missing", "arguments"),
    [
        ("python -m fenics_tfeti", "mpi4py", ("-m", "fenics_tfeti")),
        ("fenics_tfeti.Plane", "numpy", ("-c", "from fenics_tfeti import Plane")),
    ],
)
def test_without_fenicsx_the_error_says_how_to_install_it(bare_python, what, missing, arguments):
    answer = run_elsewhere(bare_python, *arguments)
    assert answer.returncode == 1
    last = answer.stderr.splitlines()[-1]
    assert (
        f"{what} needs FEniCSx, but the package '{missing}' is missing from {bare_python}" in last
    )
    for remedy in (". .venv/bin/activate", "apt install", "conda install", "pip install"):
        assert remedy in last
    assert ("Traceback" in answer.stderr) == (arguments[0] == "-c")


def test_a_dolfinx_that_does_not_start_is_told_and_there_is_no_self_test(tmp_path):
    (tmp_path / "dolfinx.py").write_text("raise ImportError('libdolfinx.so: not found')")
    answer = run_elsewhere(sys.executable, "-m", "fenics_tfeti", path=tmp_path)
    assert answer.returncode == 1
    assert "dolfinx  cannot be imported" in answer.stdout
    assert "(libdolfinx.so: not found)" in answer.stdout
    assert "self-test" not in answer.stdout


def test_other_missing_packages_are_not_taken_for_fenicsx():
    with pytest.raises(ModuleNotFoundError, match="no_such_package"), needs_fenicsx("this"):
        import no_such_package  # noqa: F401


@pytest.mark.parametrize(
    ("processes", "load", "environment", "number", "is_many"),
    [
        (1, 0.2, {}, 4, False),
        (1, 1.7, {}, 4, True),
        (2, 0.2, {}, 4, True),
        (2, 0.2, {"OMP_NUM_THREADS": "2,1"}, 2, False),
        (4, 9.0, {"OMP_NUM_THREADS": "1"}, 1, False),
        (1, 0.2, {"OMP_NUM_THREADS": "8", "OPENBLAS_NUM_THREADS": "2"}, 2, False),
        (1, 0.2, {"OMP_NUM_THREADS": "many"}, 4, False),
    ],
)
def test_threads_of_blas_beside_busy_cores(processes, load, environment, number, is_many):
    text = threads(processes, 4, load, environment)
    assert text.startswith(f"{number} for BLAS in each process, 4 cores, {round(load)} of them")
    assert text.endswith("OMP_NUM_THREADS=1)") == is_many
