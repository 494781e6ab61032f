"""The first joint drawn in CAD: a lug on a loose pin in a fork, with clearance."""

from __future__ import annotations

import numpy as np
import pytest
from joints import (
    CLEARANCE,
    PULL,
    joint_problem,
    largest_mean_pressure,
    plane_joint,
    read_joint,
)


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


STRAIGHT_AND_CURVED = ((1, {"initial_gap": CLEARANCE}), (2, {}))


@pytest.mark.parametrize("exchange", [False, True], ids=["holes", "pin"])
def test_prescribed_clearance_gives_about_the_pressure_of_curved_cells(exchange):
    """Means over a few facets; over smaller areas those of degree 1 are larger, most at edges."""
    means, largest = [], []
    for degree, options in STRAIGHT_AND_CURVED:
        problem = joint_problem(read_joint(1.5, degree), degree, exchange, **options)
        problem.solve()
        lug, fork = problem.contact
        means.append([largest_mean_pressure(lug, 0.0, 4.9), largest_mean_pressure(fork, 5.0, 12.0)])
        largest.append([lug.pressure.max(), fork.pressure.max()])
    mean, at_nodes = np.divide(*means), np.divide(*largest)
    assert mean.min() > 1.0 / 1.3 and mean.max() < 1.3
    assert at_nodes.min() > 0.5 and at_nodes.max() < 2.0


@pytest.mark.parametrize("exchange", [False, True], ids=["hole", "pin"])
@pytest.mark.parametrize("size", [2.0, 1.5, 1.0])
def test_largest_pressure_of_a_prescribed_clearance_in_the_plane(size, exchange):
    """The hole has no edges that press into the pin; with finer cells it is 86 MPa."""
    largest = []
    for degree, options in STRAIGHT_AND_CURVED:
        problem = plane_joint(size, degree, exchange, **options)
        problem.solve()
        largest.append(problem.contact[0].pressure.max())
    straight, curved = largest
    assert curved == pytest.approx(86.0, rel=0.01)
    assert straight == pytest.approx(curved, rel=0.2)


def test_clearance_below_the_deviation_of_the_facets_is_told():
    meshes = read_joint(2.5, 1)
    with pytest.warns(UserWarning, match=r"pin in (lug|fork): the clearance of the mesh") as told:
        joint_problem(meshes, 1)
    assert sum("deviation of the facets" in str(w.message) for w in told) == 2
