"""Exact non-penetration: the deformed surfaces touch, and report and forces say so."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from scenes import CLAMPED, SLAVE, Scene, at, fixed, normal_forces, plane
from stepped_blocks import two_blocks

from fenics_tfeti import Deformed, NotConverged, Sphere

COMM = MPI.COMM_WORLD

pytestmark = pytest.mark.once

YOUNG = 1e6
GAPS = Deformed(tolerance=1e-7)
SLIDING = Deformed(tolerance=1e-4, max_passes=40)
OPTIONS = {"rtol": 1e-8}
BUMP = Sphere(centre=(0.75, -1.0, 0.0), radius=1.0)


class MovingDisc:
    """The bump, whose centre can change."""

    centre = BUMP.centre

    def __call__(self, x):
        return Sphere(self.centre, BUMP.radius)(x)


def block_over_bump(moves=(0.25, -0.03), n=16, obstacle=BUMP, gaps=GAPS):
    """A block whose top is moved sideways and down, over a rigid disc."""
    parts, marks = [((0, 0), (1, 0.5), (n, n // 2))], [(CLAMPED, at(1, 0.5)), (SLAVE, at(1, 0.0))]
    scene = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks, young=YOUNG)
    scene.fix(CLAMPED, None, np.array(moves))
    scene.add_obstacle(SLAVE, obstacle)
    return scene.problem(gaps=gaps, options=OPTIONS)


@pytest.fixture(scope="module")
def over_bump():
    """Return the solved problem of the block over the disc, and its displacement."""
    problem = block_over_bump()
    return problem, problem.solve()


def distance_to_bump(problem, uh):
    """Return the distances of the deformed slave nodes to the disc, from the displacement alone."""
    contact = problem.results[0]
    x = contact.coordinates[:, :2] + uh.x.array.reshape(-1, 2)[contact.nodes]
    return np.linalg.norm(x - np.array(BUMP.centre[:2]), axis=1) - BUMP.radius


def test_deformed_nodes_are_on_the_obstacle_where_they_press(over_bump):
    problem, uh = over_bump
    distance, pressing = distance_to_bump(problem, uh), problem.results[0].active
    assert pressing.any() and not pressing.all()
    assert np.abs(distance[pressing]).max() <= 1e-7 * 0.3
    assert distance.min() >= -1e-7 * 0.3


def test_linearised_conditions_leave_an_error():
    """Otherwise the test above would show nothing."""
    problem = block_over_bump(gaps=None)
    distance = distance_to_bump(problem, problem.solve())
    assert np.abs(distance[problem.results[0].active]).max() > 1e-3


def test_forces_are_along_the_deformed_normals(over_bump):
    problem, uh = over_bump
    contact = problem.results[0]
    x = contact.coordinates[:, :2] + uh.x.array.reshape(-1, 2)[contact.nodes]
    inward = np.array(BUMP.centre[:2]) - x
    inward /= np.linalg.norm(inward, axis=1)[:, None]
    angle = np.linalg.norm(contact.normal - inward, axis=1)
    tilt = np.sqrt(np.average(angle**2, weights=contact.nodal_normal_force))
    first, last = problem.report.passes[0], problem.report.passes[-1]
    assert tilt == pytest.approx(last.tilt, rel=1e-6, abs=1e-14)
    assert last.tilt <= 1e-7 and first.tilt > 1e-2


def test_seconds_of_each_pass_and_of_all():
    """They add up to those of the phases; the first solve has the set-up."""
    problem = block_over_bump(n=8)
    for step in range(2):
        problem.solve()
        seconds, passes = dict(problem.report.seconds), problem.report.passes
        assert all(one.seconds > 0.0 for one in passes)
        assert sum(one.seconds for one in passes) == pytest.approx(seconds["total"], rel=1e-12)
        assert sum(seconds.values()) == pytest.approx(2.0 * seconds["total"], rel=1e-12)
        assert seconds["deformed surfaces"] > 0.0
        assert ("partition" in seconds) == (step == 0)


def test_passes_converge_and_reuse_what_stays(over_bump):
    problem, _ = over_bump
    passes = problem.report.passes
    assert passes[-1].error <= GAPS.tolerance
    assert 2 <= len(passes) <= 8
    assert problem.report.reused == ["factors", "multipliers"]
    assert passes[-1].products < passes[0].products


def test_flat_contact_needs_no_pass():
    """A plane is the same wherever the body slides along it."""
    problem = block_over_bump((0.3, -0.01), 8, plane(1, 2))
    problem.solve()
    assert len(problem.report.passes) == 1


def test_limit_of_passes():
    with pytest.raises(NotConverged, match="max_passes") as caught:
        block_over_bump(gaps=replace(GAPS, max_passes=1)).solve()
    assert not caught.value.report.converged


@pytest.mark.parametrize("slide", [0.01, 0.3])
def test_bodies_that_slide(slide):
    problem = two_blocks(slide, OPTIONS, gaps=SLIDING)
    problem.solve()
    assert problem.report.passes[-1].error <= 1e-4


def test_sliding_on_a_plane_moves_the_force_along():
    """The gaps hardly change, but the force on the master acts at another place."""
    slid = two_blocks(0.3, OPTIONS, upper=9, height=0.0, gaps=Deformed())
    there = two_blocks(0.3, OPTIONS, upper=9, height=0.0, start=0.3)
    slid.solve()
    there.solve()
    found, expected = (problem.report.contacts[0] for problem in (slid, there))
    force = expected.force_on_master
    np.testing.assert_allclose(found.force_on_master, force, atol=5e-3 * abs(force[1]))
    np.testing.assert_allclose(found.moment_on_master, expected.moment_on_master, rtol=5e-3)


# distances are of second order in what the last pass changed along the surface
SAME = np.sqrt(2.0 * GAPS.tolerance * 0.3)


def moved(problem, *moves):
    """Prescribe other displacements of the top."""
    tags = problem.contacts[0].facet_tags
    problem.bcs = [fixed(problem.space, tags, CLAMPED, i, move) for i, move in enumerate(moves)]
    return problem


def test_pushed_in_steps(over_bump):
    """The way does not matter, and the last geometry is nearer than the undeformed one."""
    steps = block_over_bump((0.2, -0.03))
    steps.solve()
    uh = moved(steps, 0.25, -0.03).solve()
    at_once, expected = over_bump
    np.testing.assert_allclose(uh.x.array, expected.x.array, atol=SAME)
    assert len(steps.report.passes) < len(at_once.report.passes)


def test_obstacle_moved():
    bump = MovingDisc()
    steps = block_over_bump(obstacle=bump)
    steps.solve()
    bump.centre = (0.7, -0.99, 0.0)
    uh = steps.solve()
    at_once = block_over_bump(obstacle=Sphere(bump.centre, 1.0)).solve()
    np.testing.assert_allclose(uh.x.array, at_once.x.array, atol=SAME)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("slide", "upper"),
    [
        (0.01, 9),
        *(
            pytest.param(*case, marks=pytest.mark.heavy)
            for case in [(0.01, 12), (0.3, 12), (0.3, 9)]
        ),
    ],
)
def test_bodies_that_slide_on_all_ranks(slide, upper):
    """On matching meshes, and with mortars."""
    options = {**OPTIONS, "subdomain_size": 200}
    problem = two_blocks(slide, options, comm=COMM, upper=upper, gaps=SLIDING)
    alone = two_blocks(slide, options, comm=MPI.COMM_SELF, upper=upper, gaps=SLIDING)
    problem.solve()
    alone.solve()
    mine, theirs = problem.report.passes, alone.report.passes
    assert len(mine) == len(theirs)
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(
            [one.penetration, one.separation, one.slip, one.tilt],
            [other.penetration, other.separation, other.slip, other.tilt],
            rtol=1e-3,
            atol=1e-7,
        )
    np.testing.assert_allclose(normal_forces(problem), normal_forces(alone), rtol=1e-5)
    found, expected = (p.results[0].gather() for p in (problem, alone))
    order, expected_order = (np.argsort(c.coordinates[:, 0]) for c in (found, expected))
    np.testing.assert_allclose(
        found.nodal_normal_force[order],
        expected.nodal_normal_force[expected_order],
        atol=1e-4 * expected.nodal_normal_force.max(),
    )
