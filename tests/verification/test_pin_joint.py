"""The first joint drawn in CAD: a lug on a loose pin in a fork, with clearance."""

from mpi4py import MPI

import numpy as np
import pytest
from joints import (
    CLEARANCE,
    PULL,
    axial_motion,
    joint_problem,
    largest_mean_pressure,
    plane_joint,
    read_joint,
)

from fenics_tfeti import InputError

pytestmark = pytest.mark.once

# slaves are the holes or the pin
SIDES = {"holes": {}, "pin": {"exchange": True}, "auto": {"roles": "auto"}}


@pytest.fixture(
    scope="module",
    params=[
        (1, "holes"),
        (1, "pin"),
        pytest.param((1, "auto"), marks=pytest.mark.heavy),
        pytest.param((2, "pin"), marks=pytest.mark.heavy),
    ],
    ids=lambda param: f"{param[1]}, degree {param[0]}",
)
def solved(request):
    degree, side = request.param
    meshes = read_joint(2.5, degree)
    problem = joint_problem(meshes, degree, **SIDES[side])
    return meshes, problem, problem.solve()


def check_motions(meshes, problem, uh):
    """Lug and pin are free to move along the pin, and stay where they are."""
    assert problem.report.converged
    assert max(map(abs, axial_motion(meshes, uh).values())) < 0.1
    free = problem.report.free_motions
    assert ["[-9, 30]" in motion for motion in free] == [True, False]
    assert all(motion.endswith("]: translation along (0, 0, 1)") for motion in free)


def test_motions_and_pressure(solved):
    """The lug may swing about the pin, and the pin turn about its axis."""
    check_motions(*solved)
    report = solved[1].report
    for motion in report.weak_motions:
        assert "rotation about the axis" in motion and "which close 'pin in " in motion
        assert f"weak motion  {motion}" in str(report)
    for contact in solved[1].results:
        along = contact.nodal_normal_force @ contact.normal[:, 0]
        assert abs(along) == pytest.approx(PULL, rel=1e-3)


@pytest.mark.heavy
@pytest.mark.parametrize("size", [3.0, 2.0, 1.5])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("exchange", [False, True], ids=["holes", "pin"])
def test_finer_and_coarser_joints(size, degree, exchange):
    """Of the finest with degree 2 and the pin as slave, the lug swings with a resistance of 3e-4.

    GG' squares it: a projector that is not accurate there takes thousands of products.
    """
    meshes = read_joint(size, degree)
    problem = joint_problem(meshes, degree, exchange)
    check_motions(meshes, problem, problem.solve())
    assert problem.report.products["total"] < 150


def test_a_load_along_the_pin_is_an_error_that_names_the_motion():
    problem = joint_problem(read_joint(2.5, 1), 1, along=1e-6)
    with pytest.raises(InputError, match=r"translation along \(0, 0, 1\)"):
        problem.solve()


STRAIGHT_AND_CURVED = ((1, {"initial_gap": CLEARANCE}), (2, {}))


@pytest.mark.heavy
@pytest.mark.parametrize("exchange", [False, True], ids=["holes", "pin"])
def test_prescribed_clearance_gives_about_the_pressure_of_curved_cells(exchange):
    """Means over a few facets; over smaller areas those of degree 1 are larger, most at edges."""
    means, largest = [], []
    for degree, options in STRAIGHT_AND_CURVED:
        problem = joint_problem(read_joint(1.5, degree), degree, exchange, **options)
        problem.solve()
        lug, fork = problem.results
        means.append([largest_mean_pressure(lug, 0.0, 4.9), largest_mean_pressure(fork, 5.0, 12.0)])
        largest.append([lug.pressure.max(), fork.pressure.max()])
    mean, at_nodes = np.divide(*means), np.divide(*largest)
    assert mean.min() > 1.0 / 1.3 and mean.max() < 1.3
    assert at_nodes.min() > 0.5 and at_nodes.max() < 2.0


@pytest.mark.parametrize(("size", "exchange"), [(2.0, False), (1.5, True), (1.0, False)])
def test_largest_pressure_of_a_prescribed_clearance_in_the_plane(size, exchange):
    """The hole has no edges that press into the pin; with finer cells it is 86 MPa."""
    largest = []
    for degree, options in STRAIGHT_AND_CURVED:
        problem = plane_joint(size, degree, exchange, **options)
        problem.solve()
        largest.append(problem.results[0].pressure.max())
    straight, curved = largest
    assert curved == pytest.approx(86.0, rel=0.01)
    assert straight == pytest.approx(curved, rel=0.2)


def test_clearance_below_the_deviation_of_the_facets_is_told():
    meshes = read_joint(2.5, 1)
    with pytest.warns(UserWarning, match=r"pin in (lug|fork): the clearance of the mesh") as told:
        joint_problem(meshes, 1)
    assert sum("deviation of the facets" in str(w.message) for w in told) == 2


@pytest.mark.ranks(2)
@pytest.mark.parametrize("degree", [1, pytest.param(2, marks=pytest.mark.heavy)])
def test_motions_and_pressures_are_those_of_one_rank(degree):
    outcomes = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        meshes = read_joint(2.5, degree, comm)
        problem = joint_problem(meshes, degree, True, initial_gap=0.02)
        motion = axial_motion(meshes, problem.solve())
        assert max(map(abs, motion.values())) < 0.1
        report, contacts = problem.report, [contact.gather() for contact in problem.results]
        assert len(report.free_motions) == 2
        assert all("translation along (0, 0, 1)" in motion for motion in report.free_motions)
        outcomes.append(
            [len(report.weak_motions), *(contact.pressure.max() for contact in contacts)]
        )
    assert outcomes[0] == pytest.approx(outcomes[1], rel=1e-3)


@pytest.mark.ranks(2)
def test_sizes_of_clearance_and_deviation_are_the_same():
    entries = [
        joint_problem(read_joint(2.5, 1, comm), 1)._torn.undeformed.all_conditions[0].summary
        for comm in (MPI.COMM_WORLD, MPI.COMM_SELF)
    ]
    for key in ("pairs", "deviation", "blurred", "mean_gap"):
        assert entries[0][key] == pytest.approx(entries[1][key], rel=1e-9)
