"""The code in the documentation runs as it stands there, block after block."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import textwrap
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import scenes

from fenics_tfeti import ContactProblem

DOCS = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^( *)\.\. code-block:: (python|console)\n\n((?:\1 +\S.*\n|\s*\n)+)", re.M)


def run_blocks(page: str, given: dict[str, object] | None = None) -> dict[str, object]:
    """Run the blocks of a page, with some variables; return those of its Python code."""
    variables: dict[str, object] = dict(given or {})
    blocks = [(kind, textwrap.dedent(body).strip()) for _, kind, body in BLOCK.findall(page)]
    assert blocks
    for kind, code in blocks:
        if kind == "python":
            exec(compile(code, "<docs>", "exec"), variables)
            continue
        for line in code.splitlines():
            command = line.removeprefix("$ ").split()
            assert line.startswith("$ ") and command[0] == "python"
            subprocess.run([sys.executable, *command[1:]], check=True, timeout=100)
    return variables


def test_a_block_that_fails_is_an_error():
    with pytest.raises(ZeroDivisionError):
        run_blocks("Text\n\n.. code-block:: python\n\n    x = 1\n\n    x / 0\n\nMore text\n")
    with pytest.raises(subprocess.CalledProcessError):
        run_blocks(".. code-block:: console\n\n    $ python -c exit(3)\n")


def test_solver_alone(tmp_path, monkeypatch, capsys):
    """The square carries its load on both corners; the membrane lies on the obstacle."""
    monkeypatch.chdir(tmp_path)
    variables = run_blocks((DOCS / "solver_alone.rst").read_text())
    solution = variables["solution"]
    np.testing.assert_allclose(solution["normal_force"], [0.01, 0.01], rtol=1e-6)
    assert solution["active"].all()
    lower = np.searchsorted(solution["nodes"], [0, 1])
    np.testing.assert_allclose(solution["displacement"][lower, 1], -0.01, rtol=1e-12)
    assert "nodes touch the obstacle" in capsys.readouterr().out
    x, A, b = variables["result"].x, variables["A"], variables["b"]
    gradient, touching = A @ x - b, x == -0.2
    assert 100 < np.count_nonzero(touching) < 2000
    assert (x >= -0.2).all() and (gradient[touching] >= 0.0).all()
    assert np.linalg.norm(gradient[~touching]) <= 1e-7 * np.linalg.norm(b)


def test_running(tmp_path, monkeypatch):
    """The code for load steps, with a problem of the tests."""
    monkeypatch.chdir(tmp_path)
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 4)
    load = scene.kept[1]
    loads = [0.5 * load.value, 1.0 * load.value]
    given = {"a": scene.a, "L": scene.L, "bcs": scene.bcs, "contacts": scene.package_contacts()}
    given |= {"V": scene.V, "load": load, "loads": loads, "history": []}
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
    variables = run_blocks((DOCS / "running.rst").read_text(), given)
    assert variables["history"] == pytest.approx([0.5 * 6e7, 6e7], rel=1e-6)
    assert variables["residuals"]
    assert variables["begin"] == 0
    assert {"step.pvd", "state.npz", "step.html"} <= {p.name for p in Path("results").iterdir()}
    problem = ContactProblem(scene.a, scene.L, bcs=scene.bcs, contacts=given["contacts"])
    assert problem.restore("results/state.npz") == 2
