"""Units beside numbers, which change no number of a solve."""

from mpi4py import MPI

import pytest
import scenes

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.io.units import units_of

pytestmark = pytest.mark.once


@pytest.mark.parametrize(
    ("system", "unit", "factor"),
    [
        ("SI", "MPa", 1e-6),
        ("SI", "mm", 1e3),
        ("mm-N-MPa", "MPa", 1.0),
        ("mm-N-MPa", "GPa", 1e-3),
        ("mm-N-MPa", "mm", 1.0),
        ("mm-N-MPa", "µm", 1e3),
        ("mm-N-MPa", "kN", 1e-3),
        ("mm-N-MPa", "", 1.0),
        ("SI", "kPa", 1e-3),
        ("SI", "MN", 1e-6),
        ("SI", "m", 1.0),
    ],
)
def test_values_are_converted_from_the_system(system, unit, factor):
    assert units_of(system).factor(unit) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("system", "unit", "known"), [("inch", "", "SI, mm-N-MPa"), ("SI", "psi", "Pa, kPa, MPa")]
)
def test_unknown_units_are_errors_that_list_the_known(system, unit, known):
    with pytest.raises(InputError, match=known):
        units_of(system).factor(unit)


@pytest.mark.parametrize(("units", "thickness", "length", "force", "energy"), [
    ("SI", None, "m", "N/m", "J/m"),
    ("mm-N-MPa", None, "mm", "N/mm", "mJ/mm"),
    ("mm-N-MPa", 1.0, "mm", "N", "mJ"),
])  # fmt: skip
def test_report_and_page_name_the_units(tmp_path, units, thickness, length, force, energy):
    """In a plane problem forces are those of a unit of length, unless its thickness is given."""
    pytest.importorskip("plotly")
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 1)
    problem = scene.problem(options={"units": units}, measure_weight=thickness)
    problem.solve()
    text = str(problem.report)
    assert f"distance [{length}]" in text and f"force [{force}]" in text
    problem.report.to_html(tmp_path / "page.html")
    assert f" {energy}</td>" in (tmp_path / "page.html").read_text()
