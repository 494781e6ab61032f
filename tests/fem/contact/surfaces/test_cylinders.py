"""Normals of faceted round cylinders without their tilt along the axis."""

from mpi4py import MPI

import numpy as np
import pytest

from dolfinx import mesh as dmesh

from fenics_tfeti.fem.contact.surfaces.normals import (
    FittedCylinder,
    axes_of_cylinders,
    without_axial_tilt,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.io import displacement_space

UPRIGHT = np.eye(3)
TURN = np.linalg.qr(np.array([[2.0, 1.0, 0.3], [-0.4, 1.5, 1.0], [0.2, -1.0, 2.0]]))[0]
SIDES = {"pin": 1.0, "hole": -1.0}
ROUND, TOP = 1, 2


def points_and_normals(tilt=1e-2, side="pin", span=2 * np.pi, turn=TURN, bulge=None):
    """Return points of a cylinder along z, turned, and scattered normals."""
    random = np.random.default_rng(0)
    angle, z = random.uniform(0.0, span, 300), random.uniform(-6.0, 6.0, 300)
    radius = 5.0 if bulge is None else 5.0 + bulge(angle, z)
    normals = np.column_stack([np.cos(angle), np.sin(angle), tilt * random.standard_normal(300)])
    normals *= SIDES[side] / np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    return (points + (3.0, -20.0, 4.0)) @ turn.T, normals @ turn.T


@pytest.mark.parametrize("tilt", [0.0, 1e-6, 1e-2, 0.1])
@pytest.mark.parametrize("span", [2 * np.pi, 1.0], ids=["whole", "a sixth"])
@pytest.mark.parametrize("side", SIDES)
def test_the_axis_is_known_to_rounding(tilt, span, side):
    points, normals = points_and_normals(tilt, side, span)
    cylinder = FittedCylinder.of(MPI.COMM_SELF, points, normals)
    assert abs(cylinder.axis @ TURN[:, 2]) == pytest.approx(1.0, rel=1e-15)
    assert np.abs(np.cross(cylinder.axis, TURN[:, 2])).max() < 1e-13
    assert cylinder.radius == pytest.approx(5.0, rel=1e-12)
    assert np.abs(cylinder.distance(points)).max() < 1e-12 < cylinder.tolerance


def test_coordinate_axes_are_exact():
    cylinder = FittedCylinder.of(MPI.COMM_SELF, *points_and_normals(turn=UPRIGHT))
    assert sorted(np.abs(cylinder.axis)) == [0.0, 0.0, 1.0]


def test_coordinates_of_few_digits_tell_coordinate_axes_only():
    for turn, known in ((UPRIGHT, True), (TURN, False)):
        points, normals = points_and_normals(turn=turn)
        found = FittedCylinder.of(MPI.COMM_SELF, np.round(points, 5), normals)
        assert (found is not None) == known


def test_an_axis_beside_a_coordinate_axis_is_itself():
    c, s = np.cos(1e-5), np.sin(1e-5)
    tilted = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    cylinder = FittedCylinder.of(MPI.COMM_SELF, *points_and_normals(turn=tilted))
    np.testing.assert_allclose(np.abs(cylinder.axis), np.abs(tilted[:, 2]), atol=1e-13)


@pytest.mark.parametrize(
    "bulge",
    [
        lambda angle, z: 0.1 * np.cos(2 * angle),
        lambda angle, z: 5e-3 * z,
        lambda angle, z: -1e-3 * z * z,
        lambda angle, z: 1e-3 * np.cos(7 * z),
    ],
    ids=["oval", "cone", "crown", "grooves"],
)
@pytest.mark.parametrize("turn", [UPRIGHT, TURN], ids=["upright", "turned"])
def test_what_is_no_round_cylinder(bulge, turn):
    assert FittedCylinder.of(MPI.COMM_SELF, *points_and_normals(bulge=bulge, turn=turn)) is None


@pytest.mark.parametrize("curvature", [0.0, 1e-3, 0.2], ids=["plane", "bowl", "deep bowl"])
def test_planes_and_bowls_are_none(curvature):
    x, y = np.random.default_rng(0).uniform(-3.0, 3.0, (2, 300))
    normals = np.column_stack([-curvature * x, -curvature * y, np.ones(300)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([x, y, 0.5 * curvature * (x * x + y * y)])
    assert FittedCylinder.of(MPI.COMM_SELF, points, normals) is None


def test_no_points():
    assert FittedCylinder.of(MPI.COMM_SELF, np.zeros((0, 3)), np.zeros((0, 3))) is None


def quarter_of_a_ring(comm, tags=(ROUND, TOP)):
    """Return a space on tetrahedra and tags of its round side and top; inner nodes are shifted."""
    domain = dmesh.create_box(comm, [[1.0, 0.0, 0.0], [2.0, 1.5, 1.0]], (2, 6, 5))
    dim = domain.topology.dim
    tagged = [
        dmesh.locate_entities_boundary(domain, dim - 1, lambda x: np.isclose(x[0], 2.0)),
        dmesh.locate_entities_boundary(domain, dim - 1, lambda x: np.isclose(x[2], 1.0)),
    ]
    facets = np.concatenate(tagged).astype(np.int32)
    values = np.repeat(tags, [t.size for t in tagged]).astype(np.int32)
    order = np.argsort(facets)
    tags = dmesh.meshtags(domain, dim - 1, facets[order], values[order])
    x = domain.geometry.x
    r, angle, z = x.T.copy()
    angle += 0.05 * np.sin(5 * z)
    z += 0.05 * np.sin(9 * angle) * np.sin(np.pi * z)
    x[:] = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
    return MeshBoundary.of(displacement_space(domain)), tags


def normals_of(boundary, tags, tag, chosen=lambda x: np.ones(len(x), dtype=bool)):
    surface = tagged_surface(boundary, tags, tag, "slave")
    at = chosen(surface.points)
    before = surface.normal[at]
    (axes,) = axes_of_cylinders(surface, surface.nodes[at], before)
    after = before if axes is None else without_axial_tilt(before, axes[at])
    return surface.points[at], before, after


def test_tilts_of_facets_are_removed_and_nothing_else():
    points, before, after = normals_of(*quarter_of_a_ring(MPI.COMM_SELF), ROUND)
    tilt = np.abs(before[:, 2])
    assert tilt.max() > 1e-3
    assert np.abs(after[:, 2]).max() < 1e-13
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), 1.0, rtol=1e-14)
    assert (np.abs(after - before)[:, :2].max(axis=1) <= tilt**2 + 1e-15).all()


def test_nodes_with_facets_off_the_cylinder_keep_their_normals():
    """The tag is that of the round side and of the top; contact is at the round side only."""
    points, before, after = normals_of(
        *quarter_of_a_ring(MPI.COMM_SELF, (ROUND, ROUND)),
        ROUND,
        lambda x: np.isclose(np.hypot(x[:, 0], x[:, 1]), 2.0),
    )
    rim = np.isclose(points[:, 2], 1.0)
    assert 0 < rim.sum() < len(rim)
    np.testing.assert_array_equal(after[rim], before[rim])
    assert np.abs(after[~rim, 2]).max() < 1e-13


def test_planes_keep_their_normals():
    _, before, after = normals_of(*quarter_of_a_ring(MPI.COMM_SELF), TOP)
    np.testing.assert_array_equal(after, before)
