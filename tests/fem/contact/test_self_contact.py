"""Parts of one surface that face each other: patches, roles, and nothing through a wall."""

from mpi4py import MPI

import numpy as np
import pytest
from folded import INSIDE, OUTSIDE, arc, serpentine, spiral, strip
from matching import match_contacts

import ufl
from dolfinx.fem import Constant, Function, dirichletbc, locate_dofs_geometrical
from dolfinx.mesh import CellType, compute_midpoints, create_rectangle, create_submesh

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    Deformed,
    InputError,
    Mortar,
    SelfContact,
    TiedPair,
    find_contacts,
)
from fenics_tfeti.fem.contact.search.patches_of_itself import Patches, beside_opposed
from fenics_tfeti.fem.contact.search.self_contact import SelfPatches
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic, small_strain


def patches_of(mesh, distance, tags=None, surface=None):
    boundary = MeshBoundary.of(displacement_space(mesh), None)
    contact = SelfContact(tags, surface, distance=distance)
    return SelfPatches.of(boundary, contact, "wall", is_far=True).at(None)


@pytest.mark.parametrize("sheets", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.04, 1.0])
def test_sheets_of_a_fold(sheets, distance):
    """Each faces the next one, however far one looks."""
    curve, length = serpentine(1.0, 0.11, sheets)
    mesh, _ = strip(length, 0.08, 28 * sheets, curve)
    found = patches_of(mesh, distance)
    assert len(found.patches.slave) == sheets - 1
    # as far as legs are straight
    sizes = found.patches.slave.sum(axis=1), found.patches.master.sum(axis=1)
    assert np.all(np.array(sizes) >= 24)


def test_no_node_has_both_roles():
    curve, length = serpentine(1.0, 0.11, 3)
    mesh, _ = strip(length, 0.08, 84, curve)
    found = patches_of(mesh, 0.5)
    nodes = [
        np.unique(found.surface.nodes[side.any(axis=0)])
        for side in (found.patches.slave, found.patches.master)
    ]
    assert not np.intersect1d(*nodes).size


def test_turns_of_a_spiral_are_one_patch():
    mesh, _ = strip(6.0, 0.05, 240, spiral(0.3, 0.12))
    found = patches_of(mesh, 0.1)
    assert len(found.patches.slave) == 1
    assert min(found.patches.slave.sum(), found.patches.master.sum()) > 100


def coil(turns, per_turn, wire=0.2, pitch=0.32):
    """A helix of square wire with radius 1."""
    box = Box((0, -wire / 2, -wire / 2), (1, wire / 2, wire / 2), (int(turns * per_turn), 1, 1))
    mesh = boxes(MPI.COMM_SELF, [box], "hexahedron").mesh
    s, across, up = mesh.geometry.x.T.copy()
    angle, radius = 2 * np.pi * turns * s, 1.0 + across
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    mesh.geometry.x[:, 2] = up + pitch * turns * s
    return mesh


@pytest.mark.parametrize(
    ("mesh", "gap"),
    [
        (lambda: strip(6.0, 0.05, 240, spiral(0.3, 0.12))[0], 0.12 - 0.05),
        (lambda: strip(8.0, 0.05, 160, spiral(0.3, 0.25))[0], 0.25 - 0.05),
        (lambda: coil(2.25, 16), 0.32 - 0.2),
    ],
    ids=["spiral", "wide spiral", "coil"],
)
def test_the_other_side_of_a_wall_has_no_conditions(mesh, gap):
    """Where a turn faces no next one, as at the ends, its own wall's other side is nearest."""
    found = patches_of(mesh(), 0.4)
    parts = match_contacts(found.surface.boundary, found.pairs)
    gaps = np.concatenate([part.gap for part in parts])
    assert gaps.min() == pytest.approx(gap, rel=0.01)


@pytest.mark.parametrize("radius", [10.0, 4.0, 1.5])
def test_nothing_through_the_thickness(radius):
    """A sheet that is bent to most of a circle, and looks five thicknesses far."""
    thick = 0.05
    mesh, tags = strip(6.0 * radius * thick, thick, 120, arc(radius * thick))
    found = patches_of(mesh, 5.0 * thick)
    outer, inner = tags.find(INSIDE), tags.find(OUTSIDE)
    for pair in found.pairs if not found.is_empty else ():
        sides = [pair.facet_tags.find(tag) for tag in (1, 2)]
        for there, here in (sides, sides[::-1]):
            assert not (np.isin(there, outer).any() and np.isin(here, inner).any())


def test_convex_body_never_meets_itself():
    mesh, _ = strip(1.0, 0.5, 8, lambda s: (s, 0 * s, 0 * s))
    assert patches_of(mesh, 1.0).is_empty


def test_walls_that_have_come_in_face_each_other():
    """Sheets that overlap by a fifth of their thickness, as after a long load step."""
    curve, length = serpentine(1.0, 0.11, 2)
    mesh, _ = strip(length, 0.08, 56, curve)
    boundary = MeshBoundary.of(space := displacement_space(mesh), None)
    contact = SelfContact(distance=0.06)
    found = SelfPatches.of(boundary, contact, "wall", is_far=True)
    down = Function(space)
    # the upper sheet moves down by the gap of 0.03, and 0.016 more
    down.interpolate(lambda x: np.vstack([0 * x[0], -0.046 * np.clip(x[1] / 0.11, 0, 1)]))
    there = found.at(down)
    assert len(there.patches.slave) == 1 and there.patches.slave.sum() >= 24


def test_pairs_that_contradict_the_roles_of_nodes():
    """Facets 0 and 1 have a common node, 2 and 3 as well; 0 is slave of 2."""
    slave, master = np.zeros((2, 1, 4), dtype=bool)
    slave[0, 0] = master[0, 2] = True
    patches = Patches(slave, master)
    nodes = np.array([[0, 1], [1, 2], [3, 4], [4, 5]])
    pairs = np.array([[0, 1], [0, 2], [1, 3], [2, 3]])
    np.testing.assert_array_equal(patches.has(pairs), [False, True, False, False])
    np.testing.assert_array_equal(patches.cannot_have(pairs, nodes), [True, False, False, True])


def test_the_same_objects_while_nothing_changes():
    curve, length = serpentine(1.0, 0.11, 3)
    mesh, _ = strip(length, 0.08, 84, curve)
    found = patches_of(mesh, 0.06)
    assert found.at(None) is found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"surface": 3}, "facet_tags and surface belong together"),
        ({"distance": -1.0}, "the distance is -1.0; a positive number is expected"),
        ({"friction": Coulomb(lambda x: 0.1 + 0.0 * x[0])}, "friction has data that vary"),
    ],
)
def test_wrong_data(arguments, message):
    with pytest.raises(InputError, match=message):
        SelfContact(**arguments)


def test_distance_in_another_unit():
    mesh, _ = strip(1.0, 0.5, 8, lambda s: (s, 0 * s, 0 * s))
    with pytest.raises(InputError, match="larger than the whole surface"):
        patches_of(mesh, 1000.0)


@pytest.fixture(scope="module")
def slit():
    """A block with a slit from its side to beyond its middle, and its two lips' facets."""
    n, thin = 24, 1e-3
    whole = create_rectangle(MPI.COMM_SELF, [(0, 0), (2, 2)], [n, n], CellType.quadrilateral)
    h = 2 / n
    middle = compute_midpoints(whole, 2, np.arange(n * n, dtype=np.int32))
    is_cut = (middle[:, 0] < 1.25) & (abs(middle[:, 1] - 1 - h / 2) < 0.51 * h)
    mesh = create_submesh(whole, 2, np.flatnonzero(~is_cut).astype(np.int32))[0]
    x = mesh.geometry.x
    x[x[:, 1] > 1 + 0.5 * h, 1] -= h - thin
    in_slit = [lambda x, y=y: np.isclose(x[1], y) & (x[0] < 1.25 + h) for y in (1, 1 + thin)]
    tops = {3: lambda x: np.isclose(x[1], 2 - h + thin)}
    return mesh, tag_facets(mesh, tops | dict(enumerate(in_slit, 1)))


def pressed(slit, contacts):
    """The displacement under a load that closes the slit from its mouth on, and the problem."""
    mesh, tags = slit
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds, x = ufl.Measure("ds", mesh, subdomain_data=tags), ufl.SpatialCoordinate(mesh)
    a = ufl.inner(isotropic(1.0, 0.3)(u), small_strain(v)) * ufl.dx
    L = -0.002 * (2 - x[0]) * v[1] * ds(3)
    bottom = locate_dofs_geometrical(V, lambda x: np.isclose(x[1], 0))
    bc = dirichletbc(np.zeros(2), bottom, V)
    problem = ContactProblem(a, L, bcs=[bc], contacts=contacts, options={"rtol": 1e-12})
    return problem.solve().x.array.copy(), problem


@pytest.mark.parametrize(
    ("contacts", "partners"),
    [
        (lambda mesh: SelfContact(distance=0.04, name="lips"), Mortar()),
        (lambda mesh: find_contacts(mesh, itself=True, distance=0.04), None),
    ],
)
def test_lips_of_a_slit_are_those_of_two_tags(slit, contacts, partners):
    found, problem = pressed(slit, contacts(slit[0]))
    expected, tagged = pressed(slit, ContactPair(slit[1], 1, 2, partial=True, partners=partners))
    own, other = problem.results[0], tagged.results[0]
    assert 4 < own.active.sum() == other.active.sum() < own.active.size
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_contact_of_another_mesh(slit):
    _, coarse = pressed(slit, SelfContact(distance=0.04, name="lips"))
    _, problem = pressed(slit, SelfContact(distance=0.04, name="lips"))
    with pytest.raises(InputError, match="not taken over from another mesh"):
        problem.solve(coarse=coarse)


def test_nothing_to_meet_is_told(slit):
    with pytest.warns(UserWarning, match="lips: no part of the surface faces another one"):
        pressed(slit, SelfContact(slit[1], 3, name="lips"))


def prongs(contact):
    """Forces between the prongs of a fork, whose ends two growing tractions close and press.

    Gaps are those of the deformed prongs.
    """
    long, thick, gap = 6.0, 1.0, 1.0
    curve, length = serpentine(long, gap + thick, 2)
    mesh, _ = strip(length, thick, 80, curve, layers=4)
    near_ends = {
        3: lambda x: np.isclose(x[1], -thick / 2) & (x[0] < 1.01),
        4: lambda x: np.isclose(x[1], gap + 1.5 * thick) & (x[0] < 1.01),
        1: lambda x: np.isclose(x[1], thick / 2) & (x[0] < long + 1e-9),
        2: lambda x: np.isclose(x[1], thick / 2 + gap) & (x[0] < long + 1e-9),
    }
    tags = tag_facets(mesh, near_ends)
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", mesh, subdomain_data=tags)
    load = Constant(mesh, 0.0)
    held = locate_dofs_geometrical(V, lambda x: x[0] > long + 0.3)
    problem = ContactProblem(
        ufl.inner(isotropic(1e3, 0.3)(u), small_strain(v)) * ufl.dx,
        load * v[1] * ds(3) - load * v[1] * ds(4),
        bcs=[dirichletbc(np.zeros(2), held, V)],
        contacts=[contact(tags)],
        gaps=Deformed(tolerance=1e-8),
        options={"rtol": 1e-10},
    )
    forces = []
    for load.value in (0.8, 2.0):
        problem.solve()
        forces.append(abs(problem.results[0].force[1]))
    return forces


@pytest.mark.filterwarnings("ignore:.* turns by .* degrees:UserWarning")
def test_prongs_that_come_near_each_other():
    """They face each other farther apart than one looks, and are inside when they are found."""
    found = prongs(lambda tags: SelfContact(distance=0.4))
    given = {"partial": True, "roles": "given", "partners": Mortar()}
    expected = prongs(lambda tags: ContactPair(tags, 1, 2, **given))
    assert 0.0 < expected[0] < expected[1]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_sides_of_corners_that_have_come_in():
    """Where a corner is in a face, its steep side has no part in the patch."""
    normal = np.array([[-0.97, -0.24], [-0.24, 0.97], [0.0, -1.0], [0.0, 1.0]])
    pairs = np.array([[0, 2], [1, 2]])
    assert beside_opposed(pairs, normal).tolist() == [True, False]
    # alone it is the best there is
    assert not beside_opposed(pairs[:1], normal).any()


@pytest.mark.parametrize("kind", [ContactPair, TiedPair])
def test_surfaces_that_others_join_have_no_patch(kind):
    """Whatever the roles of their patch would be; what faces a third one has a patch."""
    heights = [(0.0, 1.0), (1.0, 1.5), (1.5, 2.0)]
    each = [Box((0, a), (3, b), (6, 2)) for a, b in heights]
    slabs = boxes(MPI.COMM_SELF, each, "quadrilateral")
    sides = {k: lambda x, y=y: np.isclose(x[1], y) for k, y in enumerate((1.0, 1.0, 1.5, 1.5), 1)}
    of_bodies = [(tag, place, (tag + 2) // 2) for tag, place in sides.items()]
    tags = tag_facets(slabs.mesh, of_bodies, slabs.cell_tags)
    boundary = MeshBoundary.of(displacement_space(slabs.mesh), None)

    def patches(*others):
        whole = SelfContact(distance=0.1)
        numbered = dict(enumerate(others))
        found = SelfPatches.of(boundary, whole, "slabs", is_far=True, others=numbered).at(None)
        return len(found.patches.slave)

    lower, upper = (kind(tags, slave=k, master=k + 1) for k in (1, 3))
    assert [patches(), patches(lower), patches(upper), patches(lower, upper)] == [2, 1, 1, 0]
