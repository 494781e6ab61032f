"""Surfaces of one body that touch: a crack under a uniform stress, lips of a slit ring."""

from mpi4py import MPI

import numpy as np
import pytest
from matching import match_contacts

import ufl
from dolfinx import fem
from dolfinx.mesh import locate_entities, meshtags

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    Mortar,
    Plane,
    RigidObstacle,
    SelfContact,
    TiedPair,
)
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.conditions.contact_conditions import contact_rows, row_values
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.displacement import owned_values
from fenics_tfeti.io import (
    Box,
    Interface,
    TaggedMesh,
    boxes,
    displacement_space,
    split_interfaces,
    tag_facets,
)
from fenics_tfeti.models import isotropic, small_strain

CRACK, LOW, UP, TOP, FLOOR, PRESSURE = 9, 11, 12, 3, 4, 40.0
N = 4  # cells along an edge of the block; the crack is half as wide


def cracked_block(gdim, comm=MPI.COMM_WORLD, divisions=2 * N, half=0.5):
    """Return the mesh of a block with a crack of half a length in its middle, and its tags."""
    cell = {2: "quadrilateral", 3: "hexahedron"}[gdim]
    ends = (-1.0,) * gdim, (1.0,) * gdim
    mesh = boxes(comm, [Box(*ends, (divisions,) * gdim)], cell).mesh
    mesh.topology.create_connectivity(gdim - 1, gdim)
    count = mesh.topology.index_map(gdim)
    cells = np.arange(count.size_local + count.num_ghosts, dtype=np.int32)
    on_crack = np.sort(
        locate_entities(
            mesh,
            gdim - 1,
            lambda x: (
                np.isclose(x[gdim - 1], 0) & (np.abs(x[: gdim - 1]) < 1.02 * half).all(axis=0)
            ),
        )
    )
    whole = TaggedMesh(
        mesh,
        meshtags(mesh, gdim, cells, np.ones_like(cells)),
        meshtags(mesh, gdim - 1, on_crack, np.full_like(on_crack, CRACK)),
        {},
    )
    return split_interfaces(whole, [Interface((1, 1), (LOW, UP), facets=CRACK)])


def cracked(gdim, degree, partners, comm=MPI.COMM_WORLD, **arguments):
    """Return the space and the contact of a block with a crack in its middle."""
    parts = cracked_block(gdim, comm)
    V = displacement_space(parts.mesh, degree=degree)
    pair = ContactPair(
        parts.facet_tags, LOW, UP, partial=True, partners=partners, name="crack", **arguments
    )
    return V, pair


@pytest.mark.parametrize(
    ("gdim", "degree", "partners"),
    [
        (2, 1, None),
        pytest.param(2, 1, Mortar(), marks=pytest.mark.ranks),
        (2, 2, None),
        pytest.param(3, 1, None, marks=pytest.mark.ranks),
        (3, 1, Mortar()),
        (3, 2, None),
    ],
)
def test_uniform_pressure(gdim, degree, partners):
    V, pair = cracked(gdim, degree, partners, friction=Coulomb(0.3))
    mesh = V.mesh
    ends = tag_facets(
        mesh,
        {TOP: lambda x: np.isclose(x[gdim - 1], 1), FLOOR: lambda x: np.isclose(x[gdim - 1], -1)},
    )
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=ends)
    fixed = fem.locate_dofs_topological(V, gdim - 1, ends.find(FLOOR))
    problem = ContactProblem(
        ufl.inner(isotropic(1e4, 0.0)(u), small_strain(v)) * ufl.dx,
        -fem.Constant(mesh, PRESSURE) * v[gdim - 1] * ds(TOP),
        bcs=[fem.dirichletbc(np.zeros(gdim), fixed, V)],
        contacts=[pair],
        options={"rtol": 1e-9},
    )
    problem.solve()
    crack = problem.results["crack"]
    whole, entry = crack.gather(), crack.entry
    np.testing.assert_allclose(whole.pressure, PRESSURE, rtol=1e-6)
    np.testing.assert_allclose(whole.friction.bound, 0.3 * PRESSURE * whole.area, rtol=1e-6)
    # mortar conditions have all of the surface, pairs of nodes what belongs to nodes off the tip
    width = 1.0 if degree == 2 or partners else 1.0 - 1.0 / N
    assert whole.area.sum() == pytest.approx(width ** (gdim - 1), rel=1e-12)
    assert entry.normal_force == pytest.approx(PRESSURE * whole.area.sum(), rel=1e-6)
    assert entry.force[-1] == pytest.approx(-entry.normal_force, rel=1e-6)
    assert entry.force_on_master[-1] == pytest.approx(entry.normal_force, rel=1e-6)


@pytest.mark.parametrize(("degree", "partners"), [(1, None), (1, Mortar()), (2, None)])
def test_a_displacement_that_closes_an_open_crack_fulfils_the_conditions(degree, partners):
    """The gap is zero at the tip, whose share the conditions beside it have."""
    V, pair = cracked(2, degree, partners, MPI.COMM_SELF)
    x, cells = V.mesh.geometry.x, _compat.geometry_cells(V.mesh)
    upper = np.unique(cells[x[cells, 1].mean(axis=1) > 0])
    upper = upper[np.isclose(x[upper, 1], 0)]

    def opening(x):
        return np.maximum(0.1 * (0.5 - np.abs(x[0])), 0.0)

    x[upper, 1] += opening(x[upper].T)
    closing = fem.Function(V)
    closing.interpolate(lambda x: np.stack([0 * x[0], np.where(x[1] > 0, -opening(x), 0)]))
    boundary = MeshBoundary.of(V)
    rows = contact_rows(match_contacts(boundary, [pair]), 2)
    assert (rows.gap > 0.0).all()
    moved = row_values(boundary.nodes, rows, owned_values(closing))
    np.testing.assert_allclose(moved, rows.gap, rtol=1e-12)


def mean_slip(divisions, a, slope, pressed, mu, E, nu):
    """Mean slip of a closed crack of half a length a, without tags, in a plate that is pressed.

    The pressure is along y, the crack has a slope against x. The mesh is graded to its tips.
    """
    mesh = cracked_block(2, MPI.COMM_SELF, divisions).mesh
    outside = tag_facets(mesh, {TOP: lambda x: np.isclose(np.abs(x[:2]).max(axis=0), 1.0)})
    x, y = mesh.geometry.x[:, :2].T.copy()
    beyond = 2 * np.maximum(np.abs(x) - 0.5, 0.0)
    within = 1 - (1 - 2 * np.minimum(np.abs(x), 0.5)) ** 2
    along, across = np.sign(x) * (a * within + (1 - a) * beyond**2), np.sign(y) * y**2
    c, s = np.cos(slope), np.sin(slope)
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = c * along - s * across, s * along + c * across

    V, n = displacement_space(mesh), ufl.FacetNormal(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=outside)
    problem = ContactProblem(
        ufl.inner(isotropic(E, nu)(u), small_strain(v)) * ufl.dx,
        -pressed * n[1] * v[1] * ds(TOP),
        bcs=[],
        contacts=SelfContact(distance=a / divisions, friction=Coulomb(mu), name="crack"),
        options={"rtol": 1e-9},
    )
    problem.solve()
    crack = problem.results["crack"]
    assert crack.active.all() and not crack.friction.sticking.any()
    order = np.argsort(crack.coordinates[:, 0])
    slip = np.pad(np.linalg.norm(crack.friction.slip[order], axis=1), 1)
    x = np.concatenate([[-a], crack.coordinates[order, :2] @ [c, s], [a]])
    return np.sum(np.diff(x) * (slip[1:] + slip[:-1]) / 2) / (2 * a)


@pytest.mark.once
def test_closed_oblique_crack_that_slips():
    """K_I = 0, K_II = (tau - mu sigma) sqrt(pi a): mean slip pi a (tau - mu sigma) (1 - nu^2) / E.

    For a plate without end. The square root at the tips is resolved by the graded mesh.
    """
    a, E, nu, mu, pressed, slope = 0.125, 1e4, 0.3, 0.3, 50.0, np.pi / 4
    sigma, tau = pressed * np.cos(slope) ** 2, pressed * np.sin(slope) * np.cos(slope)
    exact = np.pi * a * (tau - mu * sigma) * (1 - nu**2) / E
    coarse, fine = (mean_slip(n, a, slope, pressed, mu, E, nu) / exact for n in (32, 64))
    assert coarse < fine == pytest.approx(1.0, abs=0.01)


def pressed_and_sheared(mesh, contacts):
    """Forces (k,) and slips (k, 2) between the faces of a crack, by their places."""
    V = displacement_space(mesh)
    u, v, x = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.SpatialCoordinate(mesh)
    ds = ufl.Measure("ds", mesh, subdomain_data=tag_facets(mesh, {TOP: lambda x: x[1] > 0.99}))
    load = ufl.as_vector([0.6, -1 - x[0] / 2])
    below = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -1))
    problem = ContactProblem(
        ufl.inner(isotropic(1e3, 0.3)(u), small_strain(v)) * ufl.dx,
        ufl.dot(load, v) * ds(TOP),
        bcs=[fem.dirichletbc(np.zeros(2), below, V)],
        contacts=contacts,
        options={"rtol": 1e-12},
    )
    problem.solve()
    crack = problem.results["crack"]
    order = np.argsort(crack.coordinates[:, 0])
    is_within = np.abs(crack.coordinates[order, 0]) < 0.49
    return crack.nodal_normal_force[order][is_within], crack.friction.slip[order][is_within]


def test_crack_is_that_between_two_bodies_that_are_tied_beside_it():
    whole = cracked_block(2, MPI.COMM_SELF).mesh
    law = Coulomb(0.1)
    found = pressed_and_sheared(whole, SelfContact(distance=0.1, friction=law, name="crack"))
    halves = [Box((-1, y), (1, y + 1), (2 * N, N)) for y in (-1, 0)]
    halves = boxes(MPI.COMM_SELF, halves, "quadrilateral")
    middle = {"crack": lambda x: np.abs(x[0]) < 0.51, "beside": lambda x: np.abs(x[0]) > 0.49}
    places = [lambda x, at=at: np.isclose(x[1], 0) & at(x) for at in middle.values()]
    sides = [(2 * body + k, place, body) for body in (1, 2) for k, place in enumerate(places)]
    tags = tag_facets(halves.mesh, sides, halves.cell_tags)
    given = {"partial": True, "partners": Mortar(), "roles": "given", "friction": law}
    pair = ContactPair(tags, slave=4, master=2, name="crack", **given)
    expected = pressed_and_sheared(halves.mesh, [pair, TiedPair(tags, slave=5, master=3)])
    assert np.all(expected[0] > 0.0) and np.abs(expected[1]).min() < np.abs(expected[1]).max()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.abs(one), np.abs(other), atol=1e-9 * np.abs(other).max())


@pytest.mark.ranks
def test_lips_of_a_slit_ring():
    """Two surfaces of one body press on each other as each does on the plane of symmetry."""
    inner, outer, slit = 8.0, 12.0, 1e-3
    box = Box((inner, slit), (outer, 2 * np.pi - slit), (4, 72))
    mesh = boxes(MPI.COMM_WORLD, [box], "quadrilateral").mesh
    tags = tag_facets(mesh, {LOW: lambda x: x[1] < 1.01 * slit, UP: lambda x: x[1] > 6.282})
    V, x = displacement_space(mesh), mesh.geometry.x
    lips = [np.isclose(x[:, 1], end) for end in (slit, 2 * np.pi - slit)]
    x[:, :2] = (x[:, 0] * [np.cos(x[:, 1]), np.sin(x[:, 1])]).T
    for lip, height in zip(lips, (0.01, -0.01), strict=True):
        x[lip, 1] = height  # the lips are parallel
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(2.1e5, 0.3)(u), small_strain(v)) * ufl.dx
    # to the lips, which are at x > 0
    L = -0.2 * ufl.SpatialCoordinate(mesh)[1] * v[1] * ufl.dx
    back = fem.locate_dofs_geometrical(V, lambda x: x[0] < -11.5)
    held = fem.dirichletbc(np.zeros(2), back, V)
    planes = [RigidObstacle(tags, lip, Plane((0, 0), (0, up))) for lip, up in ((LOW, 1), (UP, -1))]

    def forces(*contacts):
        problem = ContactProblem(a, L, bcs=[held], contacts=contacts, options={"rtol": 1e-8})
        problem.solve()
        return [result.force[1] for result in problem.results], problem.u.copy()

    (on_low,), closed = forces(ContactPair(tags, LOW, UP))
    on_lips, expected = forces(*planes)
    assert on_low > 0.0
    assert [on_low, -on_low] == pytest.approx(on_lips, rel=1e-7)
    size = np.abs(expected.x.array).max()
    np.testing.assert_allclose(closed.x.array, expected.x.array, atol=1e-6 * size)
