"""Normals, gaps and penetration in the deformed state."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from moved_blocks import CELLS, Blocks, blocks, lifted, shifted, turned
from scenes import GROUND, MASTER, SLAVE, at, dimension

from dolfinx import fem

from fenics_tfeti import Mortar, Nearest, Plane, RigidObstacle, Sphere
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.deformed import deformed_contacts

COMM = MPI.COMM_WORLD

every_cell = pytest.mark.parametrize("cell", CELLS)


def sideways(gdim, *by):
    """Return a shift along the first axis and one upwards."""
    step = np.zeros(gdim)
    step[0], step[-1] = by
    return shifted(*step)


def true_gap(result, slave, partner):
    """Return how far the deformed slave is from the deformed master."""
    return result.conditions.gap - np.sum((slave - partner) * result.normal, axis=1)


def wavy(x, *y):
    return 0.1 * np.sin(3.0 * x) + (0.1 * x * y[0] if y else 0.0)


# -- pairs: motions that change no gap -----------------------------------------------------------


@every_cell
def test_normals_of_warped_facets_are_those_of_the_match(cell):
    """The same integral, once by UFL on a bent mesh and once on the deformed facets."""
    straight, bent = blocks(cell), blocks(cell)
    x = bent.mesh.geometry.x
    gdim = bent.mesh.geometry.dim
    x[:, :gdim] = lifted(wavy)(x[:, :gdim].T).T
    expected = bent.conditions(replace(bent.pair, partners=Nearest(tolerance=1.0))).normal
    result = straight.deformed(lifted(wavy), lifted(wavy))[1]
    np.testing.assert_allclose(result.normal, expected, atol=1e-13)


@every_cell
def test_rigid_motion_turns_normals_and_keeps_gaps(cell):
    scene = blocks(cell)
    Q, motion = turned(0.7, dimension(cell), shift=0.3)
    matched, result, slave, partner = scene.deformed(motion, motion)
    np.testing.assert_allclose(result.normal, matched.normal @ Q.T, atol=1e-13)
    np.testing.assert_allclose(true_gap(result, slave, partner), matched.gap, atol=1e-13)
    assert not result.penetration.any()


@every_cell
def test_rigid_motion_of_overlapping_blocks_keeps_the_penetration(cell):
    scene = blocks(cell)
    Q, motion = turned(-0.4, dimension(cell))
    closer = sideways(dimension(cell), 0.0, -0.15)
    _, result, slave, partner = scene.deformed(motion, lambda x: motion(closer(x)))
    np.testing.assert_allclose(true_gap(result, slave, partner), -0.05, atol=1e-13)
    np.testing.assert_allclose(result.penetration, 0.05, atol=1e-13)


# -- pairs: slave nodes between the master's nodes -----------------------------------------------


@every_cell
@pytest.mark.parametrize("closer", [0.05, 0.15])
def test_sliding_on_an_inclined_master(cell, closer):
    """Parallel planes, the slave slid down by two and a bit facets."""
    gdim, slope = dimension(cell), 0.5
    incline = lifted(lambda x, *y: slope * x)
    _, result, slave, partner = blocks(cell).deformed(
        incline, lambda x: incline(sideways(gdim, 0.77, -closer)(x))
    )
    expected = (0.1 - closer) / np.sqrt(1.0 + slope**2)
    np.testing.assert_allclose(true_gap(result, slave, partner), expected, atol=1e-14)
    np.testing.assert_allclose(result.penetration, max(0.0, -expected), atol=1e-14)


@every_cell
def test_level_slave_above_an_inclined_master(cell):
    """The gap is along the slave's normal, the penetration along the master's."""
    gdim, slope = dimension(cell), 0.5
    scene = blocks(cell)
    matched, result, slave, partner = scene.deformed(
        lifted(lambda x, *y: slope * (x - 1.5)), sideways(gdim, 0.4, 0.0)
    )
    x = matched.coordinates[:, 0] + 0.4
    expected = 0.1 - slope * (x - 1.5)
    np.testing.assert_allclose(true_gap(result, slave, partner), expected, atol=1e-14)
    depth = np.maximum(0.0, -expected) / np.sqrt(1.0 + slope**2)
    assert depth.max() > 0.1
    np.testing.assert_allclose(result.penetration, depth, atol=1e-14)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_sliding_on_a_curved_master(cell):
    """The master is a polygon: the gap is that to it, not to the curve nor to the node."""
    matched, result, slave, partner = blocks(cell, n=4).deformed(
        lifted(wavy), sideways(2, 0.63, 0.2)
    )
    nodes = np.linspace(0.0, 3.0, 13)
    below = np.interp(matched.coordinates[:, 0] + 0.63, nodes, 1.0 + wavy(nodes))
    np.testing.assert_allclose(true_gap(result, slave, partner), 1.3 - below, atol=1e-14)


def test_gap_above_the_middle_of_warped_quadrilaterals():
    n = 4
    half = 0.5 / n
    matched, result, slave, partner = blocks("hexahedron", n).deformed(
        lifted(lambda x, y: 0.2 * x * y), shifted(0.5 + half, half, 0.5)
    )
    x, y = matched.coordinates[:, 0] + 0.5 + half, matched.coordinates[:, 1] + half
    on_master = y < 1.0
    expected = 0.6 - 0.2 * x * y
    np.testing.assert_allclose(
        true_gap(result, slave, partner)[on_master], expected[on_master], atol=1e-14
    )


@every_cell
def test_slave_far_beyond_the_border_is_free_to_pass(cell):
    gdim = dimension(cell)
    matched, result, slave, partner = blocks(cell).deformed(None, sideways(gdim, 5.0, -0.3))
    beyond = matched.coordinates[:, 0] + 5.0 - 3.0
    np.testing.assert_allclose(true_gap(result, slave, partner), 2.0 * np.hypot(beyond, 0.2))
    assert not result.penetration.any()


@every_cell
def test_slave_less_than_half_a_facet_beyond_the_border_meets_its_plane(cell):
    """A block that bulges a little more than the one below still stands upon it."""
    gdim = dimension(cell)
    _, result, slave, partner = blocks(cell, length=1).deformed(
        lambda x: 0.99 * (x - 0.5) + 0.5, lambda x: 1.01 * (x - 0.5) + 0.5
    )
    up = gdim - 1
    height = (1.01 * 0.6 + 0.5) - (0.99 * 0.5 + 0.5)
    assert result.normal[:, up] == pytest.approx(-1.0)
    np.testing.assert_allclose(true_gap(result, slave, partner), height, atol=1e-14)


def disc(radius, centre):
    """Return the height of an arc or a cap with its pole at height 0, upwards if radius > 0."""

    def height(*x):
        square = sum((xi - ci) ** 2 for xi, ci in zip(x, centre, strict=True))
        return np.sign(radius) * (np.sqrt(radius**2 - square) - abs(radius))

    return lifted(height)


def distance_along(x, direction, centre, radius):
    """Return how far points are from a ball along unit directions."""
    offset = x - centre
    b = np.sum(offset * direction, axis=1)
    return -b - np.sqrt(b**2 - np.sum(offset**2, axis=1) + radius**2)


@every_cell
def test_gap_between_balls_is_of_second_order(cell):
    """The slave's nodes come to thirds of the master's facets, on both meshes."""
    gdim, radius, slid = dimension(cell), 2.0, 1.0 / 12.0
    pole = (1.5, 0.5)[: gdim - 1]
    errors = []
    for n in (4, 8):
        scene = blocks(cell, n)
        upper = disc(-1.5, pole)
        matched, result, slave, partner = scene.deformed(
            disc(radius, pole), lambda x, upper=upper: sideways(gdim, slid, 0.0)(upper(x))
        )
        x = matched.coordinates[:, :gdim] + slave
        expected = distance_along(x, result.normal, np.array([*pole, 1.0 - radius]), radius)
        # lines from near the border in 3D leave the master sideways
        central = np.all(np.abs(x[:, 1:-1] - 0.5) < 0.3, axis=1)
        error = (true_gap(result, slave, partner) - expected)[central]
        errors.append(np.sqrt(np.mean(error**2)))
    assert errors[0] < 0.01
    assert 3.5 < errors[0] / errors[1] < 4.5


@every_cell
def test_gap_of_balls_pole_to_pole(cell):
    """The two poles are nodes: there the gap is exact."""
    gdim = dimension(cell)
    pole = (1.5, 0.5)[: gdim - 1]
    matched, result, slave, partner = blocks(cell, n=4).deformed(disc(2.0, pole), disc(-1.5, pole))
    at_pole = np.linalg.norm(matched.coordinates[:, : gdim - 1] - pole, axis=1).argmin()
    assert true_gap(result, slave, partner)[at_pole] == pytest.approx(0.1, abs=1e-14)


# -- pairs: normals of the user ------------------------------------------------------------------


@every_cell
@pytest.mark.parametrize("partners", [None, Mortar()])
def test_given_normals_turn_with_the_surface(cell, partners):
    """Also about themselves, and where they are not those of the facets."""
    gdim = dimension(cell)
    Q, motion = turned(2.5, gdim, shift=0.3)
    given = np.array([0.3, 0.1, -1.0])[[0, 2] if gdim == 2 else slice(None)]
    matched, result, slave, partner = blocks(cell).deformed(
        motion, motion, normal=given, partners=partners
    )
    np.testing.assert_allclose(result.normal, matched.normal @ Q.T, atol=1e-13)
    if partners is None:
        # along the tilted normal between the planes
        gap = 0.1 * np.linalg.norm(given)
        np.testing.assert_allclose(true_gap(result, slave, partner), gap, atol=1e-13)


@every_cell
def test_given_normals_follow_facets_that_bend(cell):
    gdim = dimension(cell)
    incline = lifted(lambda x, *y: 0.5 * (x - 1.5))
    _, result, _, _ = blocks(cell).deformed(incline, incline, normal=-np.eye(gdim)[-1])
    expected = (0.5 * np.eye(gdim)[0] - np.eye(gdim)[-1]) / np.sqrt(1.25)
    np.testing.assert_allclose(
        result.normal, np.tile(expected, (len(result.normal), 1)), atol=1e-13
    )


# -- obstacles -----------------------------------------------------------------------------------


def at_obstacle(scene, surface, motion):
    """Return the contact before and after, and the deformed places."""
    contact = scene.obstacle(surface)
    uh = scene.displacement(motion)
    gdim = scene.mesh.geometry.dim
    before = RigidObstacle(scene.facet_tags, GROUND, Plane([0.0] * gdim, [*[0] * (gdim - 1), 1]))
    matched = scene.conditions(before)
    result = deformed_contacts([(contact, matched)], uh)[0]
    u = uh.x.array.reshape(-1, gdim)[matched.slave]
    return matched, result, matched.coordinates[:, :gdim] + u, u


@every_cell
def test_plane_gives_the_same_row_for_every_displacement(cell):
    gdim = dimension(cell)
    scene = blocks(cell)
    plane = Plane(point=[0.1] * gdim, normal=[1.0] * (gdim - 1) + [3.0])
    expected = scene.conditions(scene.obstacle(plane))
    _, result, _, _ = at_obstacle(scene, plane, turned(0.3, gdim, shift=-0.2)[1])
    np.testing.assert_allclose(result.normal, expected.normal, atol=1e-14)
    np.testing.assert_allclose(result.conditions.gap, expected.gap, atol=1e-14)


@every_cell
def test_penetration_of_a_plane(cell):
    gdim = dimension(cell)
    plane = Plane(point=[0.0] * gdim, normal=[1.0] * (gdim - 1) + [3.0])
    _, result, y, _ = at_obstacle(blocks(cell), plane, turned(0.3, gdim, shift=-0.2)[1])
    height = y @ plane.normal / np.linalg.norm(plane.normal)
    assert height.min() < -0.1 < 0.1 < height.max()
    np.testing.assert_allclose(result.penetration, np.maximum(0.0, -height), atol=1e-14)


@every_cell
def test_ball_is_evaluated_at_the_deformed_place(cell):
    gdim = dimension(cell)
    ball = Sphere((1.2, 0.4, -2.0) if gdim == 3 else (1.2, -2.0), 2.1)
    _, result, y, u = at_obstacle(blocks(cell), ball, turned(0.3, gdim, shift=0.2)[1])
    outwards = y - np.array(ball.centre)[:gdim]
    distance = np.linalg.norm(outwards, axis=1)
    normal = -outwards / distance[:, None]
    np.testing.assert_allclose(result.normal, normal, atol=1e-14)
    expected = distance - 2.1 + np.sum(u * normal, axis=1)
    np.testing.assert_allclose(result.conditions.gap, expected, atol=1e-14)
    np.testing.assert_allclose(result.penetration, np.maximum(0.0, 2.1 - distance), atol=1e-14)


@every_cell
def test_gap_alone_counts_along_the_deformed_normal(cell):
    gdim = dimension(cell)
    Q, motion = turned(0.3, gdim, shift=0.5)
    _, result, y, u = at_obstacle(blocks(cell), lambda x: 0.1 + x[gdim - 1], motion)
    np.testing.assert_allclose(result.normal, np.tile(-Q[:, -1], (len(y), 1)), atol=1e-14)
    expected = 0.1 + y[:, -1] - u @ Q[:, -1]
    np.testing.assert_allclose(result.conditions.gap, expected, atol=1e-14)


# -- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        lambda x: np.zeros(2),
        lambda x: (np.full(x.shape[1], np.nan), np.ones((2, x.shape[1])) / np.sqrt(2.0)),
        lambda x: (np.zeros(x.shape[1]), np.ones((2, x.shape[1]))),
        lambda x: (np.zeros(x.shape[1]), np.ones(2)),
    ],
    ids=["shape", "gap", "length", "normal"],
)
def test_obstacle_that_is_undefined_where_the_body_went(wrong):
    with pytest.raises(InputError, match="contact 0"):
        at_obstacle(blocks("triangle"), wrong, shifted(0.0, -0.1))


def test_folded_slave():
    def folded(x):
        return np.vstack([np.abs(x[0] - 4.0 / 3.0), x[1]])

    with pytest.raises(InputError, match="folded"):
        blocks("triangle").deformed(None, folded)


def motions(gdim):
    """Bend both blocks, slide the upper one between the nodes and into the lower one."""
    slide = np.zeros(gdim)
    slide[0], slide[-1] = 0.37, -0.2

    def height(x, *y):
        return 0.2 * np.sin(2.0 * x) + (0.1 * x * y[0] if y else 0.0)

    bend, move = lifted(height), shifted(*slide)
    return bend, lambda x: move(bend(x))


def deformed(cell, comm, kind):
    """Return places and results at the slave nodes of this rank."""
    scene = blocks(cell, n=4, comm=comm)
    gdim = dimension(cell)
    ball = Sphere((1.4, 0.4, -2.0) if gdim == 3 else (1.4, -2.0), 2.1)
    contact = {
        "pair": scene.pair,
        "obstacle": scene.obstacle(ball),
        "gap alone": scene.obstacle(lambda x: x[gdim - 1] + 0.1),
    }[kind]
    known = scene.obstacle(ball) if kind == "gap alone" else contact
    conditions, uh = scene.conditions(known), scene.displacement(*motions(gdim))
    return conditions.coordinates, deformed_contacts([(contact, conditions)], uh)[0]


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("cell", "kind"),
    [
        ("quadrilateral", "pair"),
        ("tetrahedron", "pair"),
        ("hexahedron", "obstacle"),
        ("triangle", "gap alone"),
    ],
)
def test_result_is_that_of_one_rank(cell, kind):
    places, found = deformed(cell, COMM, kind)
    every_place, expected = deformed(cell, MPI.COMM_SELF, kind)
    row = {tuple(place): k for k, place in enumerate(np.round(every_place, 9) + 0.0)}
    rows = [row[tuple(place)] for place in np.round(places, 9) + 0.0]
    assert COMM.allreduce(len(rows)) == len(every_place)
    for name in ("normal", "penetration"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name)[rows], atol=1e-13, err_msg=name
        )
    np.testing.assert_allclose(found.conditions.gap, expected.conditions.gap[rows], atol=1e-13)
    assert expected.penetration.max() > 0.01


def rings(cells):
    """A quarter ring of tetrahedra around another one, each with its cells along and up."""

    def bent(x):
        r, angle = x[0] - 10.0 * (x[0] > 6.0), x[1] + 0.05 * np.sin(5 * x[2])
        z = x[2] + 0.05 * np.sin(9 * angle) * np.sin(np.pi * x[2])
        return np.stack([r * np.cos(angle), r * np.sin(angle), z])

    lower = ((1.0, 0.0, 0.0), (2.0, 1.5, 1.0), (2, *cells[0]))
    upper = ((12.0, 0.0, 0.0), (13.0, 1.5, 1.0), (2, *cells[1]))
    marks = [(MASTER, at(0, 2.0), 1), (SLAVE, at(0, 12.0), 2)]
    return Blocks.of_boxes(MPI.COMM_SELF, "tetrahedron", [lower, upper], marks, bent)


@pytest.mark.parametrize("stretch", [1.0, 1.01])
@pytest.mark.parametrize("cells", [((6, 5), (6, 5)), ((7, 4), (6, 5))], ids=["nodes", "mortar"])
def test_normals_of_round_cylinders_stay_across_their_axis(cells, stretch):
    """Those of facets are tilted along it; rings that are turned, and wider, have turned ones."""
    (Q, motion), factors = turned(0.7, 3, 0.2), np.array([[stretch], [stretch], [1.0]])
    scene = rings(cells)
    conditions, result, *_ = scene.deformed(*2 * [lambda x: motion(factors * x)])
    assert conditions.is_mortar == (cells[0] != cells[1])
    tilt = np.abs(conditions.surface.normal[:, 2]).max()
    assert tilt > 0.02
    # the facets around a node in a corner tell all of the stretch in their plane alone
    limit = 1e-12 if stretch == 1.0 else 2.0 * (stretch - 1.0) * tilt
    assert np.abs(result.normal @ Q[:, 2]).max() < limit
    if stretch == 1.0:
        np.testing.assert_allclose(result.normal, conditions.normal @ Q.T, atol=1e-12)


@pytest.mark.ranks(2)
def test_ghosts_of_the_displacement_are_brought_up_to_date():
    scene = blocks("triangle", comm=COMM)
    conditions, uh = scene.conditions(scene.pair), scene.displacement()
    result = deformed_contacts([(scene.pair, conditions)], uh)[0]
    assert np.isfinite(uh.x.array).all()
    np.testing.assert_allclose(result.conditions.gap, 0.1, atol=1e-14)


@pytest.mark.ranks
def test_displacement_that_is_not_finite_on_one_rank():
    scene = blocks("triangle", comm=COMM)
    conditions, uh = scene.conditions(scene.pair), fem.Function(scene.V)
    if COMM.rank == COMM.size - 1:
        uh.x.array[0] = np.nan
    with pytest.raises(InputError, match="NaN"):
        deformed_contacts([(scene.pair, conditions)], uh)[0]
