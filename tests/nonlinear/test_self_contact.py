"""A surface that touches itself at finite strains, wherever that is: as two tagged surfaces."""

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from folded import serpentine, strip, tags_of_boundary

import ufl
from dolfinx.fem import Function, dirichletbc, locate_dofs_topological
from dolfinx.mesh import meshtags

from fenics_tfeti import (
    ContactPair,
    Coulomb,
    Mortar,
    NonlinearContactProblem,
    Plane,
    RigidObstacle,
    SelfContact,
    Sphere,
)
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import neo_hookean, symmetry_plane

pytestmark = pytest.mark.once

UPPER, LOWER, CUT, FIRST, SECOND = 11, 12, 13, 14, 15
RADIUS, THICK = 1.0, 0.12


def half_ring(cells):
    """Half a ring, and tags of its outside, its ends and the two halves of its inside."""
    box = Box((0, -THICK / 2), (np.pi, THICK / 2), (cells, 2))
    mesh = boxes(MPI.COMM_WORLD, [box], "quadrilateral").mesh

    tags = tag_facets(
        mesh,
        {
            UPPER: lambda x: np.isclose(x[1], THICK / 2) & (x[0] < np.pi / 2 + 1e-6),
            LOWER: lambda x: np.isclose(x[1], THICK / 2) & (x[0] > np.pi / 2 - 1e-6),
            CUT: lambda x: np.isclose(x[0], 0) | np.isclose(x[0], np.pi),
            FIRST: lambda x: np.isclose(x[1], -THICK / 2) & (x[0] < np.pi / 2 + 1e-6),
            SECOND: lambda x: np.isclose(x[1], -THICK / 2) & (x[0] > np.pi / 2 - 1e-6),
        },
    )
    angle, radius = mesh.geometry.x[:, 0].copy(), RADIUS + mesh.geometry.x[:, 1]
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.sin(angle), radius * np.cos(angle)
    return mesh, tags


def crushed(contact, loads=(0.35, 0.7, 0.955), cells=20, restored=None):
    """Forces (loads, 2) of a die and between the walls of a ring that two round dies crush.

    It may go on from a file.
    """
    mesh, tags = half_ring(cells)
    V = displacement_space(mesh)
    u, closed, die = Function(V), [0.0], 0.4 * RADIUS
    energy = neo_hookean(1.0, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 2})

    def obstacle(side):
        at = lambda: side * (RADIUS + THICK / 2 - RADIUS * closed[0] + die)  # noqa: E731
        return lambda x: Sphere((0, at()), die)(x)

    dies = [RigidObstacle(tags, UPPER, obstacle(1)), RigidObstacle(tags, LOWER, obstacle(-1))]
    problem = NonlinearContactProblem(
        ufl.derivative(energy, u, ufl.TestFunction(V)),
        u,
        bcs=[symmetry_plane(V, tags, CUT, 0)],
        contacts=[*dies, contact(tags)],
        options={"newton_rtol": 1e-9},
    )
    if restored is not None:
        problem.restore(restored)
    forces = []
    for closed[0] in loads:
        problem.solve()
        problem.advance()
        forces.append([problem.results[0].force[1], abs(problem.results[2].force[1])])
    return np.array(forces), problem


def two_tags(friction=None):
    return lambda tags: ContactPair(
        tags, FIRST, SECOND, partial=True, roles="given", friction=friction
    )


@pytest.fixture(scope="module")
def crushed_by_tags():
    return crushed(two_tags())[0]


@pytest.fixture(scope="module")
def crushed_by_itself():
    return crushed(lambda tags: SelfContact(name="wall"))


@pytest.mark.ranks
def test_walls_of_a_crushed_ring(crushed_by_itself, crushed_by_tags):
    """They face each other only once the ring is crushed, and meet in the middle of a load step."""
    forces, _ = crushed_by_itself
    assert forces[-1, 1] > 2.0 * abs(forces[0, 0])
    np.testing.assert_allclose(forces, crushed_by_tags, rtol=1e-8, atol=1e-9)


@pytest.mark.heavy
def test_walls_with_friction():
    friction = Coulomb(0.3)
    found, _ = crushed(lambda tags: SelfContact(friction=friction, name="wall"))
    expected, _ = crushed(two_tags(friction))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)


def test_results_have_one_contact_with_the_patches_in_it(crushed_by_itself):
    _, problem = crushed_by_itself
    assert problem.results.names == ("contact 0 (obstacle)", "contact 1 (obstacle)", "wall")
    wall = problem.results["wall"]
    assert wall.active.any() and np.allclose(wall.force, problem.report.contacts[2].force)


def test_step_that_passes_the_search_distance(crushed_by_tags):
    """The walls come near each other unseen, and inside: the same load is solved again."""
    found, _ = crushed(lambda tags: SelfContact(distance=0.005, name="wall"))
    np.testing.assert_allclose(found, crushed_by_tags, rtol=1e-7, atol=1e-9)


def folded_sheets(contacts):
    """Forces of a plane and of contacts on three sheets, two folds, that the plane closes."""
    thick, gap = 0.08, 0.03
    curve, length = serpentine(1.0, thick + gap, 3)
    mesh, sides = strip(length, thick, 60, curve)
    V = displacement_space(mesh)
    u, down = Function(V), [0.0]
    F = ufl.derivative(neo_hookean(1e3, 0.3)(u) * ufl.dx, u, ufl.TestFunction(V))
    tags = tag_facets(
        mesh,
        {
            1: lambda x: np.isclose(x[1], -thick / 2) & (x[0] < 1.0 + 1e-9),
            2: lambda x: np.isclose(x[1], 2 * (thick + gap) + thick / 2) & (x[0] < 1.0 + 1e-9),
        },
    )
    top = 2 * (thick + gap) + thick / 2
    plane = RigidObstacle(tags, 2, lambda x: Plane((0, top - down[0]), (0, -1))(x))
    held = [symmetry_plane(V, tags, 1, axis) for axis in (0, 1)]
    problem = NonlinearContactProblem(
        F, u, bcs=held, contacts=[plane, *contacts(mesh)], options={"newton_rtol": 1e-9}
    )
    for down[0] in np.array([0.55, 1.1, 1.65]) * gap:
        problem.solve()
        problem.advance()
    return u.x.array.copy(), problem


@pytest.mark.heavy
def test_two_folds_at_once():
    """As with the facets of the patches tagged by hand."""
    found, problem = folded_sheets(lambda mesh: [SelfContact(tags_of_boundary(mesh), 1)])
    (patches,) = problem._torn._search._patches.values()
    assert len(patches.pairs) == 2

    def by_hand(mesh):
        for pair in patches.pairs:
            tags = meshtags(mesh, 1, pair.facet_tags.indices, pair.facet_tags.values)
            yield ContactPair(tags, 1, 2, partial=True, partners=Mortar(), roles="given")

    expected, tagged = folded_sheets(by_hand)
    assert all(result.active.any() for result in tagged.results)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def energy_around_an_axis(u):
    """The energy of a Neo-Hookean material by the area of a plane through the axis x = 0."""
    r, G = ufl.SpatialCoordinate(u.function_space.mesh)[0], ufl.grad(u)
    J, squares = ufl.det(ufl.Identity(2) + G) * (1 + u[0] / r), ufl.inner(G, G) + (u[0] / r) ** 2
    mu, lmbda = 1e3 / 2.6, 1e3 * 0.3 / (1.3 * 0.4)
    trace = 2 * (ufl.tr(G) + u[0] / r) + squares
    return 2 * ufl.pi * r * (mu / 2 * trace - mu * ufl.ln(J) + lmbda / 2 * ufl.ln(J) ** 2)


def one_fold(gdim, contact, degree=1, is_axisymmetric=False):
    """Forces, per depth, of a plane and of two sheets that it closes.

    The upper one has the larger facets, and is the slave.
    """
    thick, gap, leg, depth = 0.08, 0.03, 0.6, 0.04
    curve, length = serpentine(leg, thick + gap, 2)
    ends = (0, -thick / 2, 0)[:gdim], (length, thick / 2, depth)[:gdim]
    cell = {2: "quadrilateral", 3: "hexahedron"}[gdim]
    mesh = boxes(MPI.COMM_SELF, [Box(*ends, (28, 2, 1)[:gdim])], cell).mesh
    outside = {
        1: lambda x: np.isclose(x[1], -thick / 2) & (x[0] < leg + 1e-9),
        2: lambda x: np.isclose(x[1], -thick / 2) & (x[0] > length - leg - 1e-9),
        FIRST: lambda x: np.isclose(x[1], thick / 2) & (x[0] < length / 2 + 1e-9),
        SECOND: lambda x: np.isclose(x[1], thick / 2) & (x[0] > length / 2 - 1e-9),
    }
    tags = tag_facets(mesh, outside)
    sides = {3: lambda x: np.isclose(x[2], 0) | np.isclose(x[2], depth)} if gdim == 3 else {}
    lateral = tag_facets(mesh, sides) if sides else None
    s, y = mesh.geometry.x[:, :2].T.copy()
    x0, y0, angle = curve(s + 0.02 * s * (s / length - 1.0))
    mesh.geometry.x[:, 0] = x0 - y * np.sin(angle)
    mesh.geometry.x[:, 1] = y0 + y * np.cos(angle)
    mesh.geometry.x[:, 0] += 1.0 if is_axisymmetric else 0.0
    V = displacement_space(mesh, degree)
    u, down, top = Function(V), [0.0], thick + gap + thick / 2
    weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0] if is_axisymmetric else None
    energy = energy_around_an_axis(u) if is_axisymmetric else neo_hookean(1e3, 0.3)(u)
    rule = {"quadrature_degree": 2 * degree} if degree > 1 else {}
    point, normal = (lambda: (0, top - down[0], 0)[:gdim]), (0, -1, 0)[:gdim]
    plane = RigidObstacle(tags, 2, lambda x: Plane(point(), normal)(x))
    bcs = [symmetry_plane(V, tags, 1, axis) for axis in (0, 1)]
    bcs += [symmetry_plane(V, lateral, 3, 2)] if sides else []
    problem = NonlinearContactProblem(
        ufl.derivative(energy * ufl.dx(metadata=rule), u, ufl.TestFunction(V)),
        u,
        bcs=bcs,
        contacts=[plane, contact(tags)],
        measure_weight=weight,
        options={"newton_rtol": 1e-9},
    )
    for down[0] in (0.8 * gap, 1.3 * gap):
        problem.solve()
        problem.advance()
    return np.array([r.force[1] for r in problem.results]) / (depth if gdim == 3 else 1.0)


@cache
def smooth_fold(gdim):
    return one_fold(gdim, lambda tags: SelfContact())


def test_fold_of_a_sheet_in_space():
    """As in plane strain, but for the quadrature of the energy."""
    np.testing.assert_allclose(smooth_fold(3), smooth_fold(2), rtol=1e-5)


@pytest.mark.heavy
def test_fold_of_a_sheet_of_degree_2_in_space():
    found, expected = (one_fold(gdim, lambda tags: SelfContact(), degree=2) for gdim in (3, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_fold_around_an_axis():
    """As of the two sheets, tagged by hand."""
    given = {"partial": True, "roles": "given"}
    expected, found = (
        one_fold(2, contact, is_axisymmetric=True)
        for contact in (
            lambda tags: ContactPair(tags, SECOND, FIRST, **given),
            lambda tags: SelfContact(),
        )
    )
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert abs(found[1]) > 0.1 * abs(found[0])


def test_fold_with_friction():
    """As of the two sheets, tagged by hand."""
    friction = Coulomb(0.3)
    given = {"partial": True, "roles": "given", "friction": friction}
    expected = one_fold(2, lambda tags: ContactPair(tags, SECOND, FIRST, **given))
    found = one_fold(2, lambda tags: SelfContact(friction=friction))
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    # without friction the plane has another force
    assert abs(smooth_fold(2)[0] / found[0] - 1.0) > 1e-3


def dragged(contact):
    """Forces on a short sheet, per step, that its end presses and drags along a long one; patches.

    It comes to where it faced nothing, and goes back.
    """
    thick, gap, leg = 0.08, 0.03, 1.0
    curve, length = serpentine(leg, thick + gap, 2)
    mesh, _ = strip(length - 0.5, thick, 36, curve)
    tags = tag_facets(
        mesh,
        {
            1: lambda x: np.isclose(x[1], -thick / 2) & (x[0] < leg + 1e-9),
            2: lambda x: np.isclose(x[0], 0.5) & (x[1] > thick / 2 + gap / 2),
            FIRST: lambda x: np.isclose(x[1], thick / 2) & (x[0] < leg + 1e-9),
            SECOND: lambda x: np.isclose(x[1], thick / 2 + gap) & (x[0] < leg + 1e-9),
        },
    )
    V = displacement_space(mesh)
    u, motion = Function(V), Function(V)
    F = ufl.derivative(neo_hookean(1e3, 0.3)(u) * ufl.dx, u, ufl.TestFunction(V))
    bcs = [symmetry_plane(V, tags, 1, axis) for axis in (0, 1)]
    bcs.append(dirichletbc(motion, locate_dofs_topological(V, 1, tags.find(2))))
    problem = NonlinearContactProblem(
        F, u, bcs=bcs, contacts=[contact(tags)], options={"newton_rtol": 1e-9}
    )
    forces, patches = [], []
    for way in (0.0, -0.06, -0.12, -0.06):
        motion.x.array.reshape(-1, 2)[:] = (way, -1.2 * gap)
        problem.solve()
        problem.advance()
        forces.append(problem.results[0].force)
        patches += [known.patches for known in problem._torn._search._patches.values()]
    return np.array(forces), patches


def test_slip_stays_where_patches_change():
    """As of the two sheets, tagged by hand."""
    friction = Coulomb(0.3)
    found, patches = dragged(lambda tags: SelfContact(distance=0.02, friction=friction))
    assert patches[0] is not patches[-1]
    given = {"partial": True, "partners": Mortar(), "roles": "given", "friction": friction}
    expected, _ = dragged(lambda tags: ContactPair(tags, SECOND, FIRST, **given))
    np.testing.assert_allclose(found, expected, rtol=1e-7)


@pytest.mark.heavy
def test_checkpoint_with_patches(tmp_path):
    """A run that goes on from a file has the forces, and the patches, of one that did not end."""
    friction = Coulomb(0.3)
    loads = (0.35, 0.7, 0.955, 0.96)
    expected, whole = crushed(lambda tags: SelfContact(friction=friction), loads)
    _, first = crushed(lambda tags: SelfContact(friction=friction), loads[:3])
    first.save(tmp_path / "step.npz")
    found, again = crushed(
        lambda tags: SelfContact(friction=friction), loads[3:], restored=tmp_path / "step.npz"
    )
    np.testing.assert_allclose(found[-1], expected[-1], rtol=1e-6)
    pressing = [problem.results[2].active.sum() for problem in (whole, again)]
    assert pressing[0] == pressing[1] > 0
