"""Nodes that a contact shares with another contact, a tie, a support or moving rigid bodies."""

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from pairwise import pairwise

import ufl
from dolfinx.fem import dirichletbc, locate_dofs_topological

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    Plane,
    RigidBody,
    RigidObstacle,
    TiedPair,
)
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic, small_strain, symmetry_plane

pytestmark = [pytest.mark.ranks(1, 2, 3), pytest.mark.once]

COMM = MPI.COMM_WORLD
LEFT, LEFT_MASTER, TOP, RIGHT, RIGHT_MASTER, BASE, SIDE = 1, 2, 3, 4, 5, 6, 7


def level(axis, value, low=-9.0, high=9.0):
    """Return a locator of a level in one direction, between places in the other."""

    def locate(x):
        along = x[1 - axis]
        return np.isclose(x[axis], value) & (along > low - 1e-9) & (along < high + 1e-9)

    return locate


def form(V, E, nu=0.0):
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    return ufl.inner(isotropic(E, nu)(u), small_strain(v)) * ufl.dx


def held(V, tags, tag, value=(0.0, 0.0)):
    return dirichletbc(np.array(value), locate_dofs_topological(V, 1, tags.find(tag)), V)


@cache
def joint(kind, first=0.0, second=0.0, *, end=1.0, begin=1.0, angle=0.0):
    """Solve two blocks, turned by an angle: one contact or tie up to `end`, another from `begin`.

    The contacts have two coefficients of friction. Returns displacements in the blocks' frame,
    pressures and tractions along the joint, and the report.
    """
    bodies = boxes(
        COMM, [Box((0, 0), (2, 1), (8, 4)), Box((0, 1), (2, 2), (8, 4))], "quadrilateral"
    )
    marks = [
        (LEFT, level(1, 1, high=end), 1),
        (LEFT_MASTER, level(1, 1, high=end), 2),
        (RIGHT, level(1, 1, begin), 1),
        (RIGHT_MASTER, level(1, 1, begin), 2),
        (BASE, level(1, 0)),
        (TOP, level(1, 2)),
        (SIDE, level(0, 0), 2),
    ]
    marks = marks if begin < 2.0 else marks[:2] + marks[4:]
    tags = tag_facets(bodies.mesh, marks, bodies.cell_tags)
    c, s = np.cos(angle), np.sin(angle)
    Q = np.array([[c, -s], [s, c]])
    bodies.mesh.geometry.x[:, :2] = bodies.mesh.geometry.x[:, :2] @ Q.T
    V = displacement_space(bodies.mesh)
    v = ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=bodies.mesh, subdomain_data=tags)
    left, right = (Coulomb(mu) if mu else None for mu in (first, second))
    tie = TiedPair(tags, LEFT, LEFT_MASTER, name="left")
    pair = ContactPair(tags, LEFT, LEFT_MASTER, friction=left, name="left")
    contacts = [tie if kind == "tie" else pair]
    if begin < 2.0:
        contacts.append(ContactPair(tags, RIGHT, RIGHT_MASTER, friction=right, name="right"))
    bcs = [held(V, tags, BASE)]
    traction = Q @ [300.0 * bool(first or second), -1000.0]
    if not (first or second):
        bcs.append(symmetry_plane(V, tags, SIDE, 0))
    L = ufl.inner(ufl.as_vector(traction.tolist()), v) * ds(TOP)
    options = {"rtol": 1e-9}
    problem = ContactProblem(form(V, 1e6), L, bcs=bcs, contacts=contacts, options=options)
    u = problem.solve().x.array.reshape(-1, 2) @ Q
    return u, [along_the_joint(result.gather()) for result in problem.results], problem.report


def along_the_joint(result):
    """Return pressures and tractions (k, 2) by ascending x; a tie has none."""
    if not hasattr(result, "pressure"):
        return None
    order = np.argsort(result.coordinates @ [1.0, 0.5, 0.0])
    friction = result.friction
    return result.pressure[order], None if friction is None else friction.traction[order]


def assert_same(found, expected):
    size = COMM.allreduce(np.abs(expected).max(), MPI.MAX)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 * size)


def test_halves_have_the_pressure_of_the_whole():
    _, results, _ = joint("halves")
    for pressure, _ in results:
        np.testing.assert_allclose(pressure, 1000.0, rtol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_halves_with_friction_slip_as_the_whole(angle):
    u, ((left, _), (right, _)), report = joint("halves", 0.4, 0.4, angle=angle)
    whole, ((pressure, _),), report_of_whole = joint("halves", 0.4, end=2.0, begin=2.0)
    assert_same(u, whole)
    assert left[-1] == pytest.approx(right[0], rel=1e-12)
    np.testing.assert_allclose(np.append(left, right[1:]), pressure, rtol=1e-5, atol=0.1)
    works = [sum(c.friction_work for c in r.contacts) for r in (report, report_of_whole)]
    assert works[0] == pytest.approx(works[1], rel=1e-6)
    assert report.equilibrium < 1e-8


def test_halves_with_two_coefficients_have_each_its_law():
    """The node that both have slips with the traction of each."""
    _, results, report = joint("halves", 0.2, 0.4)
    assert report.unknowns["friction"] == 9
    at_node = []
    for (pressure, traction), mu, node in zip(results, (0.2, 0.4), (-1, 0), strict=True):
        traction = np.linalg.norm(traction, axis=1)
        assert np.all(traction <= mu * pressure * (1.0 + 1e-6))
        assert traction[node] == pytest.approx(mu * pressure[node], rel=1e-6)
        at_node.append(pressure[node])
    assert at_node[0] == pytest.approx(at_node[1], rel=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_friction_beside_a_tie(angle):
    """As with a contact that is tagged one facet shorter; the tied rows are along the axes."""
    u, _, report = joint("tie", second=0.4, angle=angle)
    assert_same(u, joint("tie", second=0.4, begin=1.25)[0])
    assert report.equilibrium < 1e-8


def test_friction_down_to_a_support():
    """The lowest node of the side cannot reach the plane."""
    found = []
    for first in (0.0, 0.25):
        mesh = boxes(COMM, [Box((0, 0), (2, 1), (8, 4))], "quadrilateral").mesh
        marks = [
            (LEFT, lambda x, first=first: level(1, 1)(x) | level(0, 2, first)(x)),
            (BASE, level(1, 0)),
            (SIDE, level(0, 0)),
        ]
        tags = tag_facets(mesh, marks)
        V = displacement_space(mesh)
        plane = RigidObstacle(tags, LEFT, Plane((0, 0.99), (0, -1)), friction=Coulomb(0.4))
        bcs = [symmetry_plane(V, tags, BASE, 1), symmetry_plane(V, tags, SIDE, 0)]
        options = {"rtol": 1e-9}
        problem = ContactProblem(form(V, 1e6, 0.3), 0, bcs=bcs, contacts=[plane], options=options)
        found.append(problem.solve().x.array)
    assert_same(*found)


@cache
def block():
    mesh = boxes(COMM, [Box((0, 0), (4, 1), (16, 4))], "quadrilateral").mesh
    tags = tag_facets(mesh, {BASE: level(1, 0), TOP: level(1, 1)})
    return displacement_space(mesh), tags


def lifted(contacts, lift=0.1):
    """Solve a block that is pushed up."""
    V, tags = block()
    bcs = [held(V, tags, BASE, (0.0, lift))]
    problem = ContactProblem(
        form(V, 1e6, 0.3), 0, bcs=bcs, contacts=contacts, options={"rtol": 1e-8}
    )
    problem.solve()
    return problem


def top_of(problem):
    """Return the vertical displacements of the nodes at the top, and where they are."""
    V, _ = block()
    x = V.tabulate_dof_coordinates()
    top = np.isclose(x[:, 1], 1.0)
    return problem.u.x.array.reshape(-1, 2)[top, 1], x[top, 0]


def plate(
    x_of_body, *, gap=lambda x: 1.0 - x[1], name="lid", stiffness=1e5, turns=False, force=0.0
):
    """Return a plate above the block that moves vertically, on a spring."""
    body = RigidBody(
        (x_of_body, 1.0),
        force=(0.0, -force),
        translation=(0, None),
        rotation=None if turns else 0,
        spring=(0, stiffness, 0.1 * stiffness * turns),
        name=name,
    )

    def surface(x):
        return gap(x), np.tile([[0.0], [-1.0]], (1, x.shape[1]))

    return RigidObstacle(block()[1], TOP, surface, rigid_body=body, name=name)


def stop(curvature):
    def surface(x):
        return 1.05 + curvature * (x[0] - 2) ** 2 - x[1], np.tile([[0.0], [-1.0]], (1, x.shape[1]))

    return RigidObstacle(block()[1], TOP, surface, name="stop")


@pytest.mark.parametrize(
    ("order", "turns", "curvature"),
    pairwise([1, -1], [False, True], [0.0, -0.003]),
)
def test_stop_behind_a_lid(order, turns, curvature):
    """All nodes touch both; rows of the stop and of the lid depend on each other together."""
    problem = lifted([plate(2.0, turns=turns), stop(curvature)][::order])
    v, x = top_of(problem)
    assert np.all(v <= 0.05 + curvature * (x - 2) ** 2 + 1e-8)
    lid = problem.rigid_bodies["lid"]
    assert lid.translation[1] == pytest.approx(0.05, rel=1e-6)
    assert problem.results["lid"].force[1] == pytest.approx(-0.05e5, rel=1e-6)
    assert problem.results["stop"].force[1] < -2e5


@pytest.mark.parametrize("order", [1, -1])
def test_node_under_two_plates(order):
    """The node that both touch is not above the lower one."""

    def inside(low, high):
        return lambda x: np.where((x[0] > low - 1e-9) & (x[0] < high + 1e-9), 1 - x[1], np.inf)

    plates = [
        plate(1.0, gap=inside(0, 2), name="A", stiffness=0, force=100.0),
        plate(3.0, gap=inside(2, 4), name="B", stiffness=0, force=200.0),
    ][::order]
    problem = lifted(plates, lift=0.0)
    lower = min(body.translation[1] for body in problem.rigid_bodies)
    v, x = top_of(problem)
    assert np.all(v[np.isclose(x, 2.0)] <= lower * (1.0 - 1e-6))
    for name, force in (("A", 100.0), ("B", 200.0)):
        assert problem.results[name].force[1] == pytest.approx(-force, rel=1e-7)
