"""The first joint drawn in CAD: a lug on a loose pin in a fork, with clearance."""

from __future__ import annotations

import numpy as np
import pytest
from joints import CLEARANCE, PULL, joint_problem, read_joint


@pytest.fixture(scope="module", params=[1, 2], ids=["degree 1", "degree 2"])
def bodies(request):
    return request.param, read_joint(2.5, request.param)


@pytest.fixture(scope="module", params=[False, True], ids=["holes", "pin"])
def solved(request, bodies):
    """Slaves are the holes or the pin."""
    degree, meshes = bodies
    problem = joint_problem(meshes, degree, exchange=request.param)
    problem.solve()
    return degree, problem


def test_motions_that_only_tilted_normals_resist_are_listed(solved):
    """Of curved cells the tilts along the pin are below 1e-3: lug and pin may move far."""
    degree, problem = solved
    report = problem.report
    assert report.free_motions == []
    if degree == 2:
        assert any("]: translation along" in motion for motion in report.weak_motions)
    for motion in report.weak_motions:
        assert "closes only 'pin in " in motion
        assert f"weak motion  {motion}" in str(report)


def test_pressure_is_that_of_the_force(solved):
    for contact in solved[1].contact:
        along = contact.pressure * contact.area @ contact.normal[:, 0]
        assert abs(along) == pytest.approx(PULL, rel=1e-3)


@pytest.mark.parametrize("exchange", [False, True], ids=["holes", "pin"])
def test_prescribed_clearance_gives_about_the_pressure_of_curved_cells(exchange):
    """At the edges of the holes it grows with each refinement, and faster with degree 1."""
    largest = []
    for degree, options in ((1, {"initial_gap": CLEARANCE}), (2, {})):
        problem = joint_problem(read_joint(2.0, degree), degree, exchange, **options)
        problem.solve()
        largest.append([contact.pressure.max() for contact in problem.contact])
    ratio = np.divide(*largest)
    assert ratio.min() > 0.5 and ratio.max() < 2.0


def test_clearance_below_the_deviation_of_the_facets_is_told():
    meshes = read_joint(2.5, 1)
    with pytest.warns(UserWarning, match=r"pin in (lug|fork): the clearance of the mesh") as told:
        joint_problem(meshes, 1)
    assert sum("deviation of the facets" in str(w.message) for w in told) == 2
