"""The eigenvalues of theorem 11.1 as benchmarks/theory.py finds them, against dense algebra."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from torn import column

from fenics_tfeti.feti import Options, TornSolver

pytestmark = pytest.mark.once


@pytest.fixture
def theory(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    yield pytest.importorskip("theory")
    for name in ("theory", "beams"):
        sys.modules.pop(name, None)


def solver(n: int) -> TornSolver:
    return TornSolver(column(n), Options(scaling="multiplicity"))


def test_extreme_eigenvalues(theory):
    """On ker G, by a dense basis of it."""
    torn = solver(2)
    m = torn.setup.constraints.layout.size
    F = np.column_stack([torn.setup.F(e) for e in np.eye(m)])
    unit = np.eye(torn.setup.constraints.layout.size)
    Z = scipy.linalg.null_space(
        np.stack([torn.setup.projector.coarse_space.restrict(x) for x in unit], axis=1)
    )
    exact = scipy.linalg.eigvalsh(Z.T @ F @ Z)[[0, -1]]
    found = theory.extreme_eigenvalues(torn, rtol=1e-10)
    np.testing.assert_allclose(found, exact, rtol=1e-8)


def test_theorem_11_1(theory):
    """F in units of 1 / (E h): the smallest stays, the largest grows like H/h at most."""
    coarse, fine = (np.divide(theory.extreme_eigenvalues(solver(n)), n) for n in (3, 6))
    assert coarse[0] / 1.2 < fine[0] < 1.2 * coarse[0]
    assert coarse[1] < fine[1] < 2.0 * coarse[1]
