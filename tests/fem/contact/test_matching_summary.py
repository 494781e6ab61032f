"""How contacts were matched, in numbers, and in the report."""

import dataclasses
import json

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import MASTER, SLAVE
from strips import bend, matched, strips

from fenics_tfeti import ContactPair, Mapped
from fenics_tfeti.fem.geometry.vectors import angles_between


def test_summary_of_a_tilted_slave():
    """The slave is tilted by 45 degrees about (0, 1.1), and turned back by its given normal."""
    V, tags = strips(gap=0.1)
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0], [0.0, 1.0, 0.0]))
    partners = Mapped(lambda x: np.array([x[0] + 0.01, 1 + 0 * x[1], x[2]]))
    summary = matched(V, ContactPair(tags, SLAVE, MASTER, name="a", partners=partners)).summary
    assert summary == {
        "contact": "a",
        "discretisation": "node_to_node",
        "pairs": 5,
        "unmatched": 0,
        "largest_distance": pytest.approx(0.01),
        "largest_relative_distance": pytest.approx(0.01 / (0.25 * np.sqrt(2))),
        "largest_angle": pytest.approx(45.0),
        "smallest_gap": pytest.approx(0.1 / np.sqrt(2)),
        "largest_gap": pytest.approx(1.1 / np.sqrt(2)),
        "mean_gap": pytest.approx(0.6 / np.sqrt(2)),
        "covered_area": pytest.approx(np.sqrt(2)),
        "deviation": None,
        "blurred": None,
    }


def test_report_has_the_summary(tmp_path):
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 3)
    problem = scene.problem()
    problem.solve()
    problem.report.to_json(tmp_path / "report.json")
    written = json.loads((tmp_path / "report.json").read_text())["contacts"]
    found = problem.report.contacts
    assert [entry["matching"] for entry in written] == [entry.matching for entry in found]
    head, line, *more = problem.report.matching_table().splitlines()
    assert head.split()[:3] == ["contact", "discretisation", "pairs"]
    assert line == "contact 0 (pair)    node_to_node      4" + line[39:]
    # columns without an entry are left out; what is beyond 90 characters is below
    assert line.split()[-5:] == ["4", "0", "0", "0", "0"]
    assert [text.split()[-2:] for text in more] == [["[m]", "area"], ["0", "1"]]
    assert "deviation" not in head + more[0]
    long = dataclasses.replace(found[0], matching={**found[0].matching, "contact": 40 * "x"})
    report = dataclasses.replace(problem.report, contacts=[*found, long])
    lines = str(report).splitlines()
    assert max(map(len, lines)) <= 90
    assert any(text.startswith(27 * "x" + "... ") for text in lines)


def test_report_begins_with_forces_and_pressures():
    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 3)
    problem = scene.problem()
    problem.solve()
    entry, contact = problem.report.contacts[0], problem.results[0]
    assert entry.largest_pressure == contact.pressure.max() > 0.0
    assert entry.pressing == np.count_nonzero(contact.nodal_normal_force > 0.0) > 0
    blocks = str(problem.report).split("\n\n")
    forces, matching, solver = blocks[-3:]
    assert f"{entry.largest_pressure:.4g}" in forces and "load" in forces
    assert "Dirichlet condition 0" in forces
    assert matching.startswith("contact ") and "unknowns" in solver


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 30.0, 90.0, 180.0])
def test_angles(degrees):
    angle = np.radians(degrees)
    first, second = np.array([[1.0, 0.0]]), np.array([[np.cos(angle), np.sin(angle)]])
    assert angles_between(first, second) == pytest.approx([degrees], rel=1e-8)


def test_directions_that_differ_by_rounding_are_the_same():
    first = np.array([[1.0, 0.0]])
    assert angles_between(first, first + 1e-15).tolist() == [0.0]
