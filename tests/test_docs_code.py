"""The code in the documentation runs as it stands there, block after block."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^( *)\.\. code-block:: (python|console)\n\n((?:\1 +\S.*\n|\s*\n)+)", re.M)


def run_blocks(page: str) -> dict[str, object]:
    """Run the blocks of a page; return the variables of its Python code."""
    variables: dict[str, object] = {}
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
