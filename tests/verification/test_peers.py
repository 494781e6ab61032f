"""The scenes of benchmarks/peers.py on coarse meshes, by the codes that are installed."""

import importlib.util
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.once

# largest differences from the reference; GetFEM's multipliers and quadrature are others
LIMITS = {
    "getfem-mortar": {"difference": 1e-2, "work_difference": 1e-2, "pressure_difference": 0.2},
    "calculix-mortar-apart": {
        "difference": 1e-6,
        "work_difference": 1e-6,
        "pressure_difference": 1e-5,
    },
    "tfeti-rigid-scotch": {"difference": 1e-5, "pressure_difference": 1e-5},
}


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    yield pytest.importorskip("peers")
    for name in ("peers", "peers_scene", "runner"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("scene", "codes"),
    [
        ("two beams", ["tfeti"]),
        ("two beams, meshes 1:1.4", ["tfeti-apart", "getfem-mortar", "calculix-mortar-apart"]),
        pytest.param(
            "two beams, meshes 1:3",
            ["tfeti-apart", "getfem-mortar", "calculix-mortar-apart"],
            marks=pytest.mark.heavy,
        ),
        ("one beam on rigid ground", ["tfeti-rigid", "tfeti-rigid-scotch"]),
    ],
)
def test_codes_agree(peers, scene, codes):
    reference, *rows = peers.compare(scene, codes, 2)
    assert reference["force"] == pytest.approx(60e6, rel=1e-6)
    for row in (row for row in rows if "skipped" not in row):
        assert "failed" not in row
        assert row["force_difference"] < 1e-8
        for name, limit in LIMITS[row["code"]].items():
            assert row[name] < limit, (row["code"], name)


def test_codes_without_a_scene_in_common(peers):
    with pytest.raises(SystemExit, match="snesvi-icc solve none of these scenes: two beams"):
        list(peers.run(codes=["snesvi-icc"], scenes=["two beams"]))


@pytest.mark.skipif(importlib.util.find_spec("getfem") is None, reason="needs GetFEM")
def test_friction_agrees_with_getfem(monkeypatch):
    """In a process of its own: GetFEM brings another MUMPS than PETSc's."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    (found,) = importlib.import_module("runner").separately("peers_friction", divisions=5)
    assert (found["sticking"], found["nodes"]) == (4, 21)
    assert found["displacement"] < 1e-7
    assert found["normal"] < 1e-6
    assert found["tangential"] < 1e-6
