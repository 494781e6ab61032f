"""The warning where displacement gradients are not small."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
from scenes import YOUNG, two_beams

from dolfinx import fem

from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.gradients import CellStrains, large_gradients

COMM = MPI.COMM_WORLD


def test_modulus_in_other_units_is_told_once():
    """E in MPa, lengths in metres, pressure in Pa; in the report of each solve."""
    scene = two_beams(COMM, "quadrilateral", 4)
    scene.young.value = 1e-6 * YOUNG
    problem = scene.problem()
    with pytest.warns(UserWarning, match=r"grad u. is as large as .* 100% .* the units") as told:
        problem.solve()
    assert len(told) == 1
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
    assert problem.report.to_check == (str(told[0].message),)


def test_small_strains_are_not_told():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        two_beams(COMM, "quadrilateral", 4).problem().solve()


def sentences(displace, energy, weak_motions=()):
    """Return what is said of a displacement of two beams with these energies."""
    scene = two_beams(COMM, "quadrilateral", 8, gap=0.5)
    uh = fem.Function(scene.V)
    uh.interpolate(displace)
    bodies = find_bodies(scene.mesh, scene.cell_tags)
    return large_gradients(COMM, CellStrains.of(uh), bodies, energy, weak_motions)


def strained_below_turned_above(x):
    above = x[1] > 1.25
    return np.stack([1e-3 * x[0] - above * (0.5 * x[1]), 0.5 * above * x[0]])


@pytest.mark.parametrize(("energy", "told"), [((1.0, 0.0), False), ((1.0, 0.2), True)])
def test_bodies_that_turn_without_being_strained_do_not_count(energy, told):
    assert bool(sentences(strained_below_turned_above, energy)) == told


@pytest.mark.parametrize(("columns", "told"), [(1, False), (6, True)])
def test_strains_of_few_cells_do_not_count(columns, told):
    """Strained by 0.12 in some of the 16 columns of cells of one of two bodies, else by 0.09."""

    def displace(x):
        return np.stack([0.09 * x[0] + 0.03 * np.minimum(x[0], columns / 8), 0.0 * x[1]])

    assert bool(sentences(displace, (1.0, 1.0))) == told


@pytest.mark.parametrize("is_weak", [True, False])
def test_rotation_with_small_strains_is_told_in_degrees(is_weak):
    """Of the upper beam, whose grad u is skew with 0.5 in its entries."""
    name = "body 1 (cell tag 2) in [1, 3] x [1.5, 2.5]"
    weak = [f"{name}: rotation about (1, 1); resisted by tilted normals only"] * is_weak
    (text,) = sentences(strained_below_turned_above, (1.0, 0.2), weak)
    assert text.startswith(f"{name} turns by {np.degrees(0.5):.2g} degrees")
    assert ("nothing but facets holds it (body 1" in text) == is_weak
    assert ("NonlinearContactProblem" in text) != is_weak
    assert "units" not in text


@pytest.mark.parametrize("is_weak", [True, False])
def test_weak_motion_is_told_in_place_of_units(is_weak):
    """Where the body turns ten times as far as it is strained, by 0.7 and more."""
    name = "body 1 (cell tag 2) in [1, 3] x [1.5, 2.5]"
    weak = [f"{name}: rotation about (1, 1); resisted by tilted normals only"] * is_weak

    def displace(x):
        above = x[1] > 1.25
        return above * np.stack([0.5 * x[0] - 9.0 * x[1], 9.0 * x[0] - 0.5 * x[1]])

    (text,) = sentences(displace, (1.0, 1.0), weak)
    assert text.startswith(f"{name} turns by") == is_weak
    assert ("with strains up to 0.71" in text) == is_weak
    assert ("Do the units fit" in text) != is_weak


@pytest.mark.parametrize("is_finite", [False, True])
def test_strains_of_a_rotation(is_finite):
    """The strain of Green and Lagrange of a rotation by any angle is zero."""
    angle = 0.7
    A = np.array([[np.cos(angle) - 1.0, -np.sin(angle)], [np.sin(angle), np.cos(angle) - 1.0]])
    scene = two_beams(COMM, "quadrilateral", 2)
    uh = fem.Function(scene.V)
    uh.interpolate(lambda x: A @ x[:2])
    strains = CellStrains.of(uh, is_finite)
    expected = 0.0 if is_finite else np.sqrt(2.0) * (1.0 - np.cos(angle))
    np.testing.assert_allclose(strains.strain, expected, atol=1e-12)
    np.testing.assert_allclose(strains.rotation, np.sin(angle))
    np.testing.assert_allclose(strains.gradient, np.linalg.norm(A))


def told(comm):
    """Return the messages of a problem with E in MPa, lengths in metres and loads in N."""
    scene = two_beams(comm, "quadrilateral", 6)
    scene.young.value = 1e-6 * YOUNG
    problem = scene.problem(options={"rtol": 1e-8})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.solve()
    return [str(warning.message) for warning in caught]


@pytest.mark.ranks(2)
def test_rank_0_warns_as_one_rank_alone_does():
    alone, together = told(MPI.COMM_SELF), told(COMM)
    assert len(alone) == 1
    assert together == (alone if COMM.rank == 0 else [])
