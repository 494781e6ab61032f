"""Pressures that follow the deformed surface: against formulas and Newton's method with LU."""

from mpi4py import MPI

import numpy as np
import pytest
from pressurised import newton_with_lu, opening_of_tube, seal, strip, tube

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("kind", "degree", "n", "rtol"), [
    ("plane", 1, 8, 1e-2), pytest.param("plane", 2, 3, 1e-2, marks=pytest.mark.ranks),
    pytest.param("space", 1, 3, 6e-2, marks=pytest.mark.ranks),
    pytest.param("space", 2, 2, 3e-2, marks=pytest.mark.heavy),
    ("meridian", 1, 20, 1e-3), ("meridian", 2, 4, 1e-3),
])  # fmt: skip
def test_tube_opens_as_the_formula_says(kind, degree, n, rtol):
    """Cells with straight sides leave a part of a round surface out."""
    scene = tube(kind, degree, n)
    scene.set_load(1.0)
    scene.problem.solve()
    assert len(scene.problem.report.newton) <= 7
    opening = COMM.allreduce(np.abs(scene.u.x.array).max(), MPI.MAX)
    assert opening == pytest.approx(opening_of_tube(scene.pressure.value), rel=rtol)
    assert opening > 0.4


@pytest.mark.once
@pytest.mark.parametrize(
    ("make", "degree"),
    [
        (tube, 2),
        (strip, 1),
        pytest.param(tube, 1, marks=pytest.mark.heavy),
        pytest.param(strip, 2, marks=pytest.mark.heavy),
    ],
)
def test_as_many_steps_as_with_the_whole_tangent(make, degree):
    scene = make(degree=degree)
    scene.set_load(0.3)
    expected, steps = newton_with_lu(scene)
    scene.problem.solve()
    np.testing.assert_allclose(scene.u.x.array, expected, atol=1e-7)
    newton = scene.problem.report.newton
    assert len(newton) <= steps + 1
    # together, the tangents of the tube are symmetric; later steps take the set-up of the first
    assert (newton[0].corrections > 0) == (make is strip)


@pytest.mark.once
@pytest.mark.ranks
def test_seal_that_contact_alone_holds():
    """Its wall carries the pressure over its present height.

    Where the pressure jumps to 2.5 times the modulus, tangents are not positive at first.
    """
    scene = seal(newton_rtol=1e-8, subdomain_size=60)
    for load in (1.0, 1.5, 2.0):
        scene.set_load(load)
        scene.problem.solve()
        scene.problem.advance()
    # where subdomains have the whole tangent, which together is symmetric, what one or two
    # solutions to a thousandth leave is enough
    assert min(step.corrections for step in scene.problem.report.newton) <= 2
    floor, lid, wall = (result.force for result in scene.problem.results)
    assert wall[0] == pytest.approx(-0.85 * 30e6, rel=1e-6)
    assert lid[1] == pytest.approx(-floor[1], rel=1e-6)


def test_dead_loads_take_no_further_solutions():
    """The tangent is symmetric: nothing is left to GMRES where no condition presses."""
    scene = tube()
    scene.problem.solve()
    assert sum(step.corrections for step in scene.problem.report.newton) == 0


def test_error_of_the_mesh():
    """It falls with the size of cells."""
    errors = []
    for n in (4, 8):
        scene = tube("plane", 1, n)
        scene.set_load(1.0)
        scene.problem.solve()
        errors.append(scene.problem.mesh_error().entry.error)
    assert 0.4 < errors[1] / errors[0] < 0.7
