"""The residual and its scale, and the face of multipliers, at a displacement that is given."""

from dataclasses import replace

from mpi4py import MPI

import finite_strains
import numpy as np
import pytest
from finite_strains import BASE, ENDS, SLIDER, TOP
from scenes import Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import Plane, RigidBody
from fenics_tfeti.errors import format_point
from fenics_tfeti.feti import Friction
from fenics_tfeti.feti.system import RowValues
from fenics_tfeti.models import neo_hookean
from fenics_tfeti.newton.equilibrium import DeformedRows, Equilibrium, Multipliers
from fenics_tfeti.newton.face import Face
from fenics_tfeti.newton.rounding import Rounding

# the rows of the contacts
PAIR, OBSTACLE, BODY = np.split(np.arange(9), 3)


@pytest.fixture(scope="module")
def blocks():
    """Two undeformed blocks, the upper one a pair's slave, and its rows.

    An obstacle is 0.1 above it, and a rigid body touches the base of the other.
    """
    marks = [(BASE, at(1, 0.0)), (TOP, at(1, 1.0)), (SLIDER, at(1, 1.2)), (ENDS, at(1, 2.2))]
    parts = [((0, 0), (1, 1), (2, 1)), ((0, 1.2), (1, 2.2), (2, 1))]
    bodies = Scene.of_boxes(MPI.COMM_SELF, "quadrilateral", parts, marks)
    u = fem.Function(bodies.V)
    bodies.fix(BASE)
    bodies.add_pair(SLIDER, TOP)
    bodies.add_obstacle(ENDS, Plane((0.0, 2.3), (0.0, -1.0)))
    bodies.add_obstacle(BASE, Plane((0.0, 0.0), (0.0, 1.0)), rigid_body=RigidBody((0.0, 0.0)))
    problem = finite_strains.Scene.of(bodies, u, neo_hookean(1.0, 0.3)(u) * ufl.dx, print).problem
    conditions, origin = problem._torn.undeformed, problem._accepted.origin
    return problem, DeformedRows.of(conditions, u, origin)


def test_forces_of_nodes_that_slip(blocks):
    """They are at the bounds, in their directions."""
    rows = blocks[1]
    site = OBSTACLE
    tangents = np.tile([[[1.0, 0.0]]], (3, 1, 1))
    friction = Friction(site, tangents, np.zeros(3), np.zeros((3, 1)), np.full(3, 0.5))
    rows, given = replace(rows, friction=friction), Multipliers.none(rows)
    given.normal[site] = 4.0
    given.tangential[site, 0] = [1.0, -3.0, 1.5]
    given = replace(given, slipping=np.isin(np.arange(9), site[:2]))
    after = rows.at_bounds(given)
    np.testing.assert_allclose(after.tangential[site, 0], [2.0, -2.0, 1.5])


@pytest.mark.parametrize(("slid", "is_held"), [(True, True), (False, False)])
def test_nodes_that_have_slid_back_stick(blocks, slid, is_held):
    """Slip of a node that has only begun to slip has no direction yet."""
    rows, site = blocks[1], OBSTACLE[:1]
    friction = Friction(site, np.array([[[1.0, 0.0]]]), np.zeros(1), np.array([[0.1]]), np.ones(1))
    rows, given = replace(rows, friction=friction), Multipliers.none(rows)
    given.normal[site], given.tangential[site, 0] = 1.0, 1.0
    on_site = np.isin(np.arange(9), site)
    given = replace(given, slipping=on_site, slid=on_site & slid)
    face = Face.of(rows, given, 1e-12)
    assert face.held.tolist() == on_site.tolist()
    assert face.sticks.tolist() == [is_held]
    assert face.contacts.size == 9 + is_held
    assert face.friction.size == 0


def test_face_after_changes_of_forces(blocks):
    """Rows that would pull lose their forces, others that press join."""
    rows, given = blocks[1], Multipliers.none(blocks[1])
    given.normal[:2] = 4.0 / rows.contacts.length[:2]
    face, change = Face.of(rows, given, 0.0), np.zeros(9)
    change[:3] = -1.0, -5.0, 2.0
    assert face.pulling(change).tolist() == [False, True] + 7 * [False]
    changes = RowValues(change, np.zeros((0, 1)), np.zeros(0))
    for part, expected in ((1.0, [3.0, 0.0, 2.0, 0.0]), (0.5, [3.5, 1.5, 1.0, 0.0])):
        after = face.after(changes, part, face.held, np.zeros(0, dtype=bool))
        np.testing.assert_allclose(rows.normal_forces(after)[:4], expected)
    assert not face.without(face.held).multipliers.normal.any()


@pytest.mark.parametrize(
    ("pressure", "reaction", "least", "force"),
    [
        (5.0, 3.0, 0.0, np.sqrt(3.0) * 5.0),
        (5.0, 30.0, 0.0, np.sqrt(3.0) * 30.0),
        (5.0, 3.0, 20.0, 20.0),
        (0.0, 0.0, 0.0, 0.25),
    ],
)
def test_residual_relative_to_the_largest_force(blocks, pressure, reaction, least, force):
    """The obstacle's, the supports', the least one, the residual."""
    problem, rows = blocks
    nodes, given = rows.surface_nodes, Multipliers.none(rows)
    given.normal[OBSTACLE] = pressure
    forces = -rows.force(given)[0]
    forces[nodes[BODY], 0] = reaction
    forces[nodes[0]] += 0.15, -0.2
    u = np.full(forces.size, -0.2)
    result = Equilibrium.of(forces, rows, given, u, least, Rounding.none(problem._torn.nodes))
    assert result.force == pytest.approx(force)
    assert result.residual == pytest.approx(0.25 / force)
    assert result.separation == pytest.approx(0.5 if pressure else 0.0)
    assert result.place == format_point(problem._torn.nodes.coordinates[nodes[0]])


def test_penetration_before_anything_moves_is_infinite(blocks):
    """Relative to the displacement, and without a warning of NumPy."""
    problem, rows = blocks
    given, rounding = Multipliers.none(rows), Rounding.none(problem._torn.nodes)
    overlapping = replace(rows, contacts=replace(rows.contacts, gap=np.full(9, -10.0)))
    u = np.zeros_like(rows.force(given)[0])
    with np.errstate(all="raise"):
        result = Equilibrium.of(u, overlapping, given, u, 0.0, rounding)
    assert result.penetration == np.inf


@pytest.mark.parametrize(("size", "counts"), [(0.5, False), (2.0, True)])
@pytest.mark.parametrize("measure", ["residual", "penetration", "separation", "friction"])
def test_what_rounding_leaves_is_none(blocks, measure, size, counts):
    """Of forces at nodes, distances and slips, at displacements that are as small."""
    problem, rows = blocks
    nodes, given = problem._torn.nodes, Multipliers.none(rows)
    rounding = Rounding.of(problem._torn.torn.subdomains, nodes)
    length = size * rounding.length(0.0)
    gap, internal = np.zeros(9), np.zeros((nodes.owned, 2))
    if measure == "residual":
        internal[:, 0] = size * rounding.internal_forces(0.0)
    elif measure == "friction":
        site = OBSTACLE[1:2]
        slip = np.full((1, 1), -length)
        friction = Friction(site, np.array([[[1.0, 0.0]]]), np.full(1, np.inf), slip, np.zeros(1))
        rows = replace(rows, friction=friction)
        given.tangential[rows.place[site], 0] = 1e-6
    else:
        gap[OBSTACLE] = length if measure == "separation" else -length
        given.normal[OBSTACLE] = float(measure == "separation")
    rows = replace(rows, contacts=replace(rows.contacts, gap=gap * rows.contacts.length))
    u = np.full(internal.size, rounding.length(0.0))
    result = Equilibrium.of(internal, rows, given, u, 0.0, rounding)
    assert (getattr(result, measure) > 0.0) == counts


@pytest.mark.parametrize(
    ("force", "slip", "excess"),
    [
        (0.5, 0.0, 0.0),  # sticks below its bound of 2
        (2.0, 0.3, 0.0),  # slips at it
        (3.0, 0.3, 1.0),  # is above it
        (1.5, 0.3, 0.5),  # slips below it
        (0.5, 0.01, 0.1),  # has slipped by little of what the stiffness of 10 allows
        (2.0, -0.3, 3.0),  # slips against its force, the projection of which is at -1
        (0.0, 0.3, 0.0),  # has no part in the problem: a support decides the slip
    ],
)
def test_excess_over_the_law_of_friction(blocks, force, slip, excess):
    """Of a tangential force, of a normal force of 4 and a coefficient of a half."""
    rows, multipliers = blocks[1], Multipliers.none(blocks[1])
    row = OBSTACLE[1:2]
    tangent = np.array([[[1.0, 0.0]]])
    friction = Friction(row, tangent, np.zeros(1), np.full((1, 1), -slip), np.full(1, 0.5))
    rows = replace(rows, friction=friction)
    multipliers.normal[rows.place[row]] = 4.0 / rows.contacts.length[row]
    multipliers.tangential[rows.place[row], 0] = force / rows.contacts.length[row]
    assert rows.excess(multipliers, 10.0, 0.0) == pytest.approx([excess], abs=1e-14)
