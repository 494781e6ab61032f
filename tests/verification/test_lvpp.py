"""The half ball of benchmarks/peers_lvpp.py, where dolfinx has what LVPP needs."""

import importlib
import inspect
from pathlib import Path

import pytest

from dolfinx.fem import petsc

pytestmark = pytest.mark.skipif(
    "entity_maps" not in inspect.signature(petsc.NonlinearProblem).parameters,
    reason="needs dolfinx 0.10",
)


def test_half_ball(monkeypatch):
    """The conditions differ, the displacements little."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    separately = importlib.import_module("runner").separately
    (found,) = separately("peers_lvpp", divisions=4, degrees=1)
    assert found["penetration"] < 1e-12
    assert 1e-3 < found["lvpp_penetration"] < 1e-2
    assert -0.04 < found["force_difference"] < 0
    assert found["difference"] < 4e-3
