"""Gaps that replace those of the mesh."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
from curved_rings import quarter_rings
from scenes import MASTER, SLAVE
from strips import bend, matched, strips

from fenics_tfeti import ContactPair, Mortar, Nearest
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.summary import warn_of_deviation
from fenics_tfeti.fem.contact.conditions.surface_pairs import user_gaps
from fenics_tfeti.fem.geometry.normals import chord_heights
from fenics_tfeti.io import displacement_space

WAYS = (Nearest(), Mortar())


def arcs(lower, upper, gap=0.0, radius=2.0):
    """Return two strips bent around (0.5, -1): their faces are polygons of one circle."""
    V, tags = strips((lower, 2), (upper, 2), gap=0.1)

    def polar(x):
        angle = 0.8 * (x[:, 0] - 0.5)
        # the contact faces at y = 1 and 1.1 come to the same radius, up to the gap
        height = np.where(x[:, 1] > 1.05, x[:, 1] - 0.1 + gap, x[:, 1])
        r = radius - 1.0 + height
        return np.stack([0.5 + r * np.sin(angle), r * np.cos(angle) - 1.0, 0 * angle], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), polar)
    return V, tags


def test_chord_height_of_a_circle_and_a_sphere():
    angle = np.array([-0.05, 0.05])
    ends = 3.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)[None]
    assert chord_heights(ends, ends / 3.0)[0][0] == pytest.approx(
        3.0 * (1 - np.cos(0.05)), rel=1e-3
    )
    corners = np.array([[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]])
    corners = corners * 0.1 + [0.0, 0.0, (1 - 0.01) ** 0.5]
    height = 1.0 - (1 - 0.01) ** 0.5
    assert chord_heights(corners[None], corners[None])[0][0] == pytest.approx(height, rel=1e-2)


@pytest.mark.parametrize(("lower", "upper"), [(7, 10), (10, 7), (3, 12), (12, 3)])
def test_touching_polygons_of_one_circle_have_no_gaps(lower, upper):
    V, tags = arcs(lower, upper)
    geometric = matched(V, ContactPair(tags, SLAVE, MASTER))
    assert np.abs(geometric.gap).max() > 1e-4
    touching = matched(V, ContactPair(tags, SLAVE, MASTER, initial_gap="touching"))
    assert (touching.gap == 0.0).all()
    assert touching.summary["largest_gap"] == 0.0


def test_gaps_beyond_the_chords_stay():
    V, tags = arcs(7, 10, gap=0.05)
    geometric = matched(V, ContactPair(tags, SLAVE, MASTER))
    touching = matched(V, ContactPair(tags, SLAVE, MASTER, initial_gap="touching"))
    np.testing.assert_array_equal(touching.gap, geometric.gap)
    assert geometric.gap.mean() == pytest.approx(0.05, abs=0.005)


@pytest.mark.parametrize("way", WAYS)
def test_prescribed_gaps(way):
    V, tags = strips(gap=0.1)
    number = matched(V, ContactPair(tags, SLAVE, MASTER, initial_gap=-0.02, partners=way))
    np.testing.assert_array_equal(number.gap, -0.02)

    def grows(x):
        return 0.01 + x[0]

    pair = ContactPair(tags, SLAVE, MASTER, initial_gap=grows, partners=way)
    field = matched(V, pair)
    np.testing.assert_allclose(field.gap, 0.01 + field.coordinates[:, 0])
    assert field.summary["smallest_gap"] == pytest.approx(0.01)


def test_touching_nodes_of_matching_meshes():
    V, tags = arcs(8, 8, gap=1e-4)
    pair = ContactPair(tags, SLAVE, MASTER, initial_gap="touching", partners=Nearest())
    assert (matched(V, pair).gap == 0.0).all()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: x, r"returned shape \(3, 2\).* expected \(2,\)"),
        (lambda x: x[0] * np.nan, "NaN or infinite at 2 points"),
        (lambda x: "no", "expected an array of numbers, not str"),
        (lambda x: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_functions_that_return_no_gaps(function, message):
    with pytest.raises(InputError, match=message):
        user_gaps(MPI.COMM_SELF, function, np.ones((2, 3)), "joint")


def test_deviation_of_curved_facets():
    """A node in the middle takes its own height off; what that of a chord is without it stays."""
    angle = np.array([-0.05, 0.0, 0.05])
    first, middle, last = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    ends = np.stack([first, last])[None]
    straight = chord_heights(ends, ends, 0.5 * (first + last)[None, None])[1][0]
    curved = chord_heights(ends, ends, middle[None, None])[1][0]
    assert straight == pytest.approx(1.0 - np.cos(0.05), rel=1e-3)
    assert curved < 1e-3 * straight


def test_heights_on_oblique_edges_of_a_cylinder():
    """A triangle with edges around the axis, along it and oblique: only the arc counts."""
    angle, radius = np.array([0.05, -0.05, 0.05]), 2.0
    normals = np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)[None]
    corners = radius * normals + np.array([0.0, 0.0, 1.0]) * np.array([0.0, 0.0, 0.7])[:, None]
    arc = np.array([0.0, radius, 0.0]), np.array([0.0, radius, 0.35])
    middles = np.array([arc[0], arc[1], 0.5 * (corners[0, 0] + corners[0, 2])])[None]
    sagitta = radius * (1.0 - np.cos(0.05))
    assert chord_heights(corners, normals)[0][0] == pytest.approx(4.0 / 3.0 * sagitta, rel=1e-3)
    assert chord_heights(corners, normals, middles)[1][0] < 1e-3 * sagitta


@pytest.mark.parametrize("gap", [0.002, -0.002], ids=["clearance", "interference"])
def test_gaps_below_the_deviation_of_the_facets_are_told(gap):
    """7 and 10 facets on an arc of 1.6 m with radius 2 m: sagittas of 3.3 and 1.6 mm."""
    V, tags = arcs(7, 10, gap)
    entry = matched(V, ContactPair(tags, SLAVE, MASTER, name="joint")).summary
    assert entry["deviation"] == pytest.approx(2.0 * (0.8 / 7) ** 2 / 8 * (1 + 0.7**2), rel=0.01)
    kind = "clearance" if gap > 0 else "interference"
    with pytest.warns(
        UserWarning, match=rf"joint: the {kind} of the mesh.*up to 0\.00486.*initial_"
    ):
        warn_of_deviation(entry)


@pytest.mark.parametrize(
    ("gap", "options"),
    [(0.02, {}), (0.004, {"initial_gap": 0.004}), (0.0, {"initial_gap": "touching"})],
    ids=["larger", "prescribed", "touching"],
)
def test_gaps_that_facets_do_not_blur(gap, options):
    V, tags = arcs(7, 10, gap)
    entry = matched(V, ContactPair(tags, SLAVE, MASTER, **options)).summary
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_deviation(entry)


def test_point_contact_of_round_surfaces_is_not_blurred():
    """Gaps below the deviation are around the point only."""
    V, tags = strips((12, 2), (12, 2), gap=0.1)
    bend(
        V,
        lambda x: x[:, 1] > 1.05,
        lambda x: (
            x + np.stack([0 * x[:, 0] + 1e-3, (x[:, 0] - 0.5) ** 2 - 0.0999, 0 * x[:, 0]], axis=1)
        ),
    )
    entry = matched(V, ContactPair(tags, SLAVE, MASTER)).summary
    assert 0.0 < entry["blurred"] < 0.5


@pytest.mark.parametrize("recombine", [False, True], ids=["triangles", "quadrilaterals"])
def test_clearance_of_curved_cells_is_not_blurred(tmp_path, recombine):
    gap = 1e-3
    rings = quarter_rings(tmp_path / "rings.msh", (8, 11), [(1, 2), (2 + gap, 3)], recombine)
    V = displacement_space(rings.mesh, degree=2)
    entry = matched(V, ContactPair(rings.facet_tags, 11, 12)).summary
    assert entry["mean_gap"] == pytest.approx(gap, rel=2e-2)
    assert entry["deviation"] < gap and entry["blurred"] == 0.0
