"""Normals of faceted extrusions without their tilt along the axis."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.fem.contact.surfaces.extrusions import without_axial_tilt

# the axis of what is not round is looked for among the coordinate axes
UPRIGHT = np.eye(3)
TURN = np.linalg.qr(np.array([[2.0, 1.0, 0.3], [-0.4, 1.5, 1.0], [0.2, -1.0, 2.0]]))[0]
AXIS = TURN[:, 2]


def cylinder(tilt, radius=lambda angle: 5.0 + 0.0 * angle, span=2 * np.pi, turn=TURN, seed=0):
    """Return normals, places and areas of a cylinder along z, turned; `tilt` is a function of z."""
    random = np.random.default_rng(seed)
    angle, z = random.uniform(0.0, span, 300), random.uniform(-6.0, 6.0, 300)
    r, h = radius(angle), 1e-6
    slope = (radius(angle + h) - radius(angle - h)) / (2.0 * h)
    cos, sin = np.cos(angle), np.sin(angle)
    normals = np.column_stack([r * cos + slope * sin, r * sin - slope * cos, 0.0 * angle])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = tilt(z, random)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = np.column_stack([r * cos, r * sin, z]) + (3.0, -20.0, 4.0)
    return normals @ turn.T, places @ turn.T, random.uniform(0.5, 1.0, 300)


def scatter(size):
    return lambda z, random: size * random.standard_normal(z.size)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1e-2])
@pytest.mark.parametrize("span", [2 * np.pi, 1.0], ids=["whole", "a sixth"])
def test_scatter_along_a_round_cylinder_is_removed_to_rounding(size, span):
    surface = cylinder(scatter(size), span=span)
    (normals,) = without_axial_tilt(MPI.COMM_SELF, [surface])
    assert np.abs(normals @ AXIS).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-14)
    # nothing else is turned
    assert np.abs(normals - surface[0]).max() < 6.0 * size
    # again
    assert without_axial_tilt(MPI.COMM_SELF, [(normals, *surface[1:])])[0] is normals


def oval(angle):
    return 5.0 + 0.5 * np.cos(2 * angle)


def test_other_extrusions_along_a_coordinate_axis():
    surface = cylinder(scatter(1e-3), oval, turn=UPRIGHT)
    (normals,) = without_axial_tilt(MPI.COMM_SELF, [surface])
    assert (normals[:, 2] == 0.0).all()


def test_axes_that_are_not_known_to_rounding_are_none():
    """An oval along any direction: a load across it would seem to work along it."""
    surface = cylinder(scatter(1e-3), oval)
    assert without_axial_tilt(MPI.COMM_SELF, [surface])[0] is surface[0]


def test_round_cylinders_with_coordinates_of_few_digits():
    normals, places, areas = cylinder(scatter(1e-3), turn=UPRIGHT)
    (across,) = without_axial_tilt(MPI.COMM_SELF, [(normals, np.round(places, 6), areas)])
    assert (across[:, 2] == 0.0).all()


def test_bearings_of_one_shaft_have_the_same_axis():
    """Fitted axes agree to rounding; an oval along the same coordinate axis gets it exactly."""
    one, other = (
        cylinder(scatter(1e-2)),
        cylinder(scatter(1e-3), lambda angle: 4.0 + 0.0 * angle, seed=1),
    )
    both = np.concatenate(without_axial_tilt(MPI.COMM_SELF, [one, other]))
    assert np.linalg.svd(both)[1][2] < 1e-13


@pytest.mark.parametrize(
    "tilt",
    [
        lambda z, random: 0.0 * z,
        lambda z, random: 5e-3 + 1e-3 * random.standard_normal(z.size),
        lambda z, random: 2e-3 * z + 1e-3 * random.standard_normal(z.size),
        scatter(5e-2),
    ],
    ids=["none", "a cone", "a crown", "a rough surface"],
)
def test_normals_that_stay(tilt):
    surface = cylinder(tilt)
    assert without_axial_tilt(MPI.COMM_SELF, [surface])[0] is surface[0]


@pytest.mark.parametrize("curvature", [0.0, 1e-3], ids=["plane", "bowl"])
def test_planes_and_shallow_bowls_stay(curvature):
    """Normals of a bowl are across no direction, those of a plane across two."""
    x, y = np.random.default_rng(0).uniform(-5.0, 5.0, (2, 300))
    normals = np.column_stack([-curvature * x, -curvature * y, np.ones(300)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places = np.column_stack([x, y, 0.5 * curvature * (x * x + y * y)])
    assert without_axial_tilt(MPI.COMM_SELF, [(normals, places, np.ones(300))])[0] is normals


def test_no_surfaces():
    assert without_axial_tilt(MPI.COMM_SELF, []) == []
