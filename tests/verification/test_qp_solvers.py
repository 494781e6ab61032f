"""General QP solvers find the same minimisers (`benchmarks/qp_solvers.py`)."""

import importlib
import json
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.once


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    yield importlib.import_module("runner")
    for name in ("runner", "qp_solvers"):
        sys.modules.pop(name, None)


def test_all_solvers_agree(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["run.py"])
    file = tmp_path / "table.json"
    options = ["--sizes", "60", "--grids", "15", "--json", str(file)]
    table = benchmark.main(["qp_solvers", *options])
    assert {row["solver"] for row in table} == {"fenics_tfeti.qp", "PIQP", "OSQP", "Clarabel"}
    assert [row["problem"] for row in table[::4]] == ["membranes", "random 60", "obstacle 15"]
    for row in table:
        assert row["error"] < 1e-5 and row["violation"] < 1e-6, row
    own = [row["error"] for row in table if row["solver"] == "fenics_tfeti.qp"]
    assert max(own) < 1e-6
    assert len(json.loads(file.read_text())) == len(table)
