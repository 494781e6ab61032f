"""Benchmarks that others have published, by the scripts in benchmarks/published."""

import runpy
import warnings
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks" / "published"

pytestmark = pytest.mark.once


def run(name):
    """Return the variables of a script."""
    with warnings.catch_warnings():
        # the published problems strain the bodies by a tenth
        warnings.filterwarnings("ignore", r"\|grad u\|", UserWarning)
        return runpy.run_path(str(FOLDER / f"{name}.py"))


def test_nafems_roller_on_a_block():
    pytest.importorskip("gmsh")
    values = run("nafems_roller")
    assert values["a"] == pytest.approx(6.21, rel=2e-3)
    assert values["p0"] == pytest.approx(3585.37, rel=2e-3)


def test_asimov_half_disc():
    pytest.importorskip("gmsh")
    values = run("asimov_half_disc")
    assert values["a"] == pytest.approx(values["HALF_WIDTH"], rel=2e-3)
    assert values["p0"] == pytest.approx(values["LARGEST"], rel=2e-3)


def test_code_aster_spheres():
    """Half spheres are stiffer than the half spaces of the formula."""
    pytest.importorskip("gmsh")
    assert 1.0 < run("code_aster_spheres")["p0"] / 2798.3 < 1.08


def test_comet_indenter():
    """A block of finite depth is stiffer than the half space of the formula."""
    values = run("comet_indenter")
    assert 1.0 < values["computed"] / values["force"] < 1.1
    assert 1.0 < values["largest"] / values["pressure"] < 1.05


def test_code_aster_plate():
    """Of the farthest point, two digits are published."""
    values = run("code_aster_plate")
    published = list(values["PUBLISHED"].values())
    assert values["computed"][:4] == pytest.approx(published[:4], rel=3e-3)
    assert values["computed"][4] == pytest.approx(published[4], rel=0.03)


def test_code_aster_pad():
    values = run("code_aster_pad")
    assert values["forces"][0] == pytest.approx([3564.0, 12000.0], rel=1e-4)
    assert values["slips"] == pytest.approx([0.0, 9.0], abs=0.02)


def test_code_aster_blocks():
    """Exact on any two meshes."""
    values = run("code_aster_blocks")
    assert max(values["pressure_error"], values["displacement_error"]) < 1e-8


def test_pmd_press_fit():
    """The hub's radius is smaller than the formula's by the interference."""
    values = run("pmd_press_fit")
    assert values["pressure"] == pytest.approx(values["PUBLISHED"], rel=3e-3)


def test_espreso_hertz():
    """With the cube as the slave, as there; what is published has seven digits."""
    values = run("espreso_hertz")
    assert values["computed"] == pytest.approx(values["PUBLISHED"], rel=1e-5)
