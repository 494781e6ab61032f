"""``python -m fenics_tfeti.feti``: what it reads, writes and prints."""

import json
import subprocess
import sys
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from new_process import run_python
from torn import column

from fenics_tfeti.feti import Options, TornSolver, save_system
from fenics_tfeti.feti.__main__ import main

COMM = MPI.COMM_SELF


@pytest.fixture
def system(tmp_path):
    """Return the path of a system in which 3 N press a cube on two others."""
    save_system(tmp_path / "system.npz", column(load=(0, 0, -3.0)))
    return tmp_path / "system.npz"


def test_command(system, tmp_path):
    report, solution = tmp_path / "report.json", tmp_path / "solution.npz"
    command = [sys.executable, "-m", "fenics_tfeti.feti", str(system), "--rtol", "1e-9"]
    command += ["--report", str(report), "--solution", str(solution)]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert answer.returncode == 0, answer.stderr
    for words in (
        "528, in 3 subdomains",
        "16 of 16 conditions",
        "(0, 0, 3) of 'joint'",
        "converged",
    ):
        assert words in answer.stdout
    written = json.loads(report.read_text())
    assert written["converged"] and written["options"]["rtol"] == 1e-9
    assert written["contacts"][0]["normal_force"] == pytest.approx(3.0, rel=1e-8)
    arrays = dict(np.load(solution))
    assert arrays.keys() == {
        *("format", "nodes", "displacement", "normal_force", "active", "tied_force")
    }
    exact = TornSolver(column(load=(0, 0, -3.0)), Options(rtol=1e-9)).solve()
    np.testing.assert_array_equal(arrays["normal_force"], exact.normal_force)
    np.testing.assert_array_equal(arrays["active"], exact.active)
    cube = column().subdomains[2]
    at = np.searchsorted(arrays["nodes"], cube.nodes)
    np.testing.assert_array_equal(arrays["displacement"][at].ravel(), exact.displacements[2])


def test_it_runs_without_dolfinx(system):
    printed = run_python(
        "import sys\n"
        "for missing in ('dolfinx', 'ufl', 'basix', 'ffcx'): sys.modules[missing] = None\n"
        "from fenics_tfeti.feti.__main__ import main\n"
        "sys.exit(main(sys.argv[1:]))",
        str(system),
    )
    assert "converged" in printed


def test_last_iterate_is_written_where_the_limit_ends(system, tmp_path, capsys):
    report = tmp_path / "report.json"
    given = [str(system), "--max_products", "2", "--report", str(report)]
    assert main([*given, "--solution", str(tmp_path / "solution.npz")], COMM) == 1
    assert "limit of 2 products" in capsys.readouterr().out
    assert json.loads(report.read_text())["converged"] is False
    assert np.load(tmp_path / "solution.npz")["displacement"].any()


@pytest.mark.parametrize(("arguments", "message"), [
    (["--rtol", "2"], "option 'rtol' is 2.0"),
    (["--report", "/proc/none/report.json"], "the report cannot be written"),
    (["--solution", "/proc/none/solution.npz"], "the solution cannot be written"),
])  # fmt: skip
def test_errors_are_one_line(system, arguments, message, capsys):
    assert main([str(system), *arguments], COMM) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]


def test_system_that_cannot_be_solved_is_an_error(tmp_path, capsys):
    loose = replace(column(), prescribed=type(column().prescribed)())
    save_system(tmp_path / "system.npz", loose)
    assert main([str(tmp_path / "system.npz")], COMM) == 2
    assert "error: " in capsys.readouterr().err
    assert main([str(tmp_path / "missing.npz")], COMM) == 2
    assert "No such file" in capsys.readouterr().err


def test_all_options_but_one_are_on_the_command_line(capsys):
    """The exit code tells of no convergence."""
    with pytest.raises(SystemExit):
        main(["--help"], COMM)
    shown = capsys.readouterr().out
    for name in vars(Options()):
        assert (f"--{name}" in shown) == (name != "error_if_not_converged")
