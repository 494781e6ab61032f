"""Contact pairs of all bodies that are near each other: which facets, names, roles and warnings."""

import contextlib
import re
import warnings

from mpi4py import MPI

import numpy as np
import pytest
from joined_bodies import block

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Coulomb,
    InputError,
    NonlinearContactProblem,
    find_contacts,
)
from fenics_tfeti.fem.contact.surfaces.oriented import owned_facets
from fenics_tfeti.fem.topology import cell_vertices, cells_of_facets, facet_corners
from fenics_tfeti.io import Box, Interface, boxes, displacement_space, split_interfaces, tag_facets
from fenics_tfeti.models import isotropic, neo_hookean
from fenics_tfeti.parallel import concatenate_ranks

pytestmark = pytest.mark.ranks

COMM = MPI.COMM_WORLD


def middles(mesh, pair):
    """Return the sorted middles of the facets of the slave and of the master, of all ranks."""
    found = []
    for tag in (pair.slave, pair.master):
        facets = owned_facets(mesh, pair.facet_tags, tag)
        nodes = facet_corners(mesh, *cells_of_facets(mesh, facets))
        places = mesh.geometry.x[nodes].mean(axis=1)[:, : mesh.geometry.dim].round(9)
        found.append(sorted(map(tuple, concatenate_ranks(mesh.comm, places).tolist())))
    return found


def joint(*bodies, cell="quadrilateral", tagged=True, **arguments):
    """Return the mesh of boxes and the pairs that are found, without warnings."""
    made = boxes(COMM, bodies, cell)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pairs = find_contacts(made.mesh, made.cell_tags if tagged else None, **arguments)
    return made.mesh, pairs


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_facets_opposite_to_each_other(cell):
    """Of unequal meshes, on the part where the bodies overlap; the coarser body is the slave."""
    lower, upper = Box((0, 0), (2, 1), (8, 4)), Box((1, 1), (3, 2), (4, 2))
    mesh, (pair,) = joint(lower, upper, cell=cell)
    assert pair.name == "body 1 (cell tag 2) on body 0 (cell tag 1)"
    slave, master = middles(mesh, pair)
    assert slave == [(1.25, 1.0), (1.75, 1.0)]
    assert master == [(1.125, 1.0), (1.375, 1.0), (1.625, 1.0), (1.875, 1.0)]


def test_slave_of_graded_meshes():
    """A few facets that are much finer make the master, although their body's mean is coarser."""
    made = boxes(
        COMM, [Box((0, 0), (2, 1), (16, 2)), Box((0, 1), (2, 2), (20, 2))], "quadrilateral"
    )
    mesh, x = made.mesh, made.mesh.geometry.x
    fine = 0.01 * np.arange(9)
    graded = np.append(fine, np.linspace(fine[-1], 2.0, 9)[1:])
    lower = np.unique(cell_vertices(mesh)[made.cell_tags.find(1)])
    x[lower, 0] = np.interp(x[lower, 0], np.linspace(0.0, 2.0, 17), graded)
    (pair,) = find_contacts(mesh, made.cell_tags)
    assert pair.name == "body 1 (cell tag 2) on body 0 (cell tag 1)"


@pytest.mark.parametrize("cell", ["tetrahedron", "hexahedron"])
def test_bodies_that_meet_in_an_edge_are_no_pair(cell):
    """Four bricks in a stack bond; those on the diagonal have an edge in common."""
    corners = [(i, j) for i in (0, 1) for j in (0, 1)]
    bricks = [Box((i, 0, j), (i + 1, 1, j + 1), (2, 2, 2)) for i, j in corners]
    mesh, pairs = joint(*bricks, cell=cell, tagged=False)
    assert [pair.name for pair in pairs] == [
        f"body {a} on body {b}" for a, b in ((0, 1), (0, 2), (1, 3), (2, 3))
    ]
    count = 4 if cell == "hexahedron" else 8
    assert all(len(part) == count for pair in pairs for part in middles(mesh, pair))


def test_gaps():
    """Up to the size of a facet by default, or up to a distance."""
    bodies = Box((0, 0), (1, 1), (4, 4)), Box((0, 1.2), (1, 2), (4, 4))
    assert len(joint(*bodies)[1]) == 1
    assert len(joint(*bodies, distance=0.21)[1]) == 1
    made = boxes(COMM, bodies, "quadrilateral")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert find_contacts(made.mesh, distance=0.19) == []
    messages = [str(warning.message) for warning in caught]
    wanted = r"none of 2 bodies are near .* gap is 0.2, between .*find_contacts.* distance=0.202\)"
    assert all(re.search(wanted, message) for message in messages)
    assert COMM.allreduce(len(messages)) == 1
    assert len(joint(*bodies, distance=0.202)[1]) == 1


def test_bodies_beside_each_other():
    """No facet of one is opposite to one of the other, whatever their distance."""
    made = boxes(COMM, [Box((0, 0), (1, 1), (2, 2)), Box((2, 2), (3, 3), (2, 2))], "quadrilateral")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert find_contacts(made.mesh) == []
    messages = [str(warning.message) for warning in caught]
    assert (
        COMM.allreduce(sum("Up to a gap of 5 no facet is" in message for message in messages)) == 1
    )


@pytest.mark.parametrize(("slope", "facets"), [(0.05, 10), (0.3, 2)])
def test_facets_that_are_inclined(slope, facets):
    """Of a gap that opens, on meshes that grow with it: inclined facets count next to its edge."""
    slabs = [Box((0, k), (1, k + 1), (10, 2)) for k in range(2)]
    made = boxes(COMM, slabs, "quadrilateral")
    mesh, x = made.mesh, made.mesh.geometry.x
    x[:, 0] *= x[:, 0]
    upper = np.unique(cell_vertices(mesh)[made.cell_tags.find(2)])
    x[upper, 1] += slope * x[upper, 0] * (2.0 - x[upper, 1])
    (pair,) = find_contacts(mesh, made.cell_tags)
    assert [len(part) for part in middles(mesh, pair)] == [facets, facets]


def test_bodies_that_are_left_out():
    """Blocks on fine facets of a floor, with coarse and inclined sides next to each other."""
    floor, left = Box((0, -1), (2.2, 0), (44, 2)), Box((0, 0), (1, 1), (20, 2))
    made = boxes(COMM, [floor, left, Box((1.2, 0), (2.2, 1), (20, 2))], "quadrilateral")
    mesh, x = made.mesh, made.mesh.geometry.x
    right = np.unique(cell_vertices(mesh)[made.cell_tags.find(3)])
    x[right, 0] += 0.3 * x[right, 1]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert len(find_contacts(mesh, made.cell_tags)) == 2
    messages = COMM.allreduce([str(warning.message) for warning in caught])
    assert len(messages) == 1
    found = re.search(r"1 pairs of bodies get no .* body 1 .* body 2 .* distance=(.*)\)", *messages)
    assert len(find_contacts(mesh, made.cell_tags, distance=float(found[1]))) == 3
    assert len(find_contacts(mesh, made.cell_tags, whole_faces=True)) == 3


def test_body_alone_is_told():
    """The warning has what to do for cracks, and for bodies that share nodes."""
    mesh = boxes(COMM, [Box((0, 0), (1, 1), (3, 3))], "quadrilateral").mesh
    told = r"one body alone.* itself=True.*split_interfaces"
    is_first = COMM.rank == 0
    with pytest.warns(UserWarning, match=told) if is_first else contextlib.nullcontext():
        assert find_contacts(mesh) == []


def test_thin_sheets():
    """Thinner than their facets: no pairs through the body between, or through the own one."""
    sheets = [Box((0, 0.1 * k), (4, 0.1 * (k + 1)), (8, 1)) for k in range(4)]
    _, pairs = joint(*sheets, distance=1.0)
    names = [f"body {k} (cell tag {k + 1})" for k in range(4)]
    assert [pair.name for pair in pairs] == [" on ".join(names[k : k + 2]) for k in range(3)]


def test_bodies_that_overlap():
    """An interference that is drawn."""
    mesh, (pair,) = joint(Box((0, 0), (2, 1), (8, 4)), Box((0, 0.9), (2, 2), (8, 4)))
    slave, master = middles(mesh, pair)
    assert {y for _, y in slave} == {1.0} and {y for _, y in master} == {0.9}
    assert len(slave) == len(master) == 8


@pytest.mark.parametrize("overlap", [1e-6, 0.01])
def test_lap_joint_with_interference(overlap):
    """The ends of two bars are back to back, nearer than they are high: they are no partners."""
    bars = [Box((0, 0), (4, 1), (16, 1)), Box((-3.5, 1 - overlap), (0.5, 2 - overlap), (16, 1))]
    mesh, (pair,) = joint(*bars)
    slave, master = middles(mesh, pair)
    assert slave == [(0.125, 1.0), (0.375, 1.0)]
    assert master == [(0.125, 1 - overlap), (0.375, 1 - overlap)]


def test_key_in_its_way():
    """Three faces of one pair of bodies: those that meet at an edge are in two contacts."""

    def key(x):
        return np.where((np.abs(x[:, 0] - 0.5) < 0.25) & (x[:, 1] > 0.5), 1, 2)

    parts = split_interfaces(block("quadrilateral", key, COMM), [Interface((1, 2), (11, 12))])
    first, second = find_contacts(parts.mesh)
    assert second.name == f"{first.name}, side 2"
    sides, bottom = (middles(parts.mesh, pair)[0] for pair in (first, second))
    assert sides == [(0.25, 0.625), (0.25, 0.875), (0.75, 0.625), (0.75, 0.875)]
    assert bottom == [(0.375, 0.5), (0.625, 0.5)]


def test_whole_faces():
    """Up to the edges of the bodies, and not around them."""
    lower, upper = Box((0, 0), (4, 1), (8, 2)), Box((1, 1), (2, 2), (2, 2))
    mesh, (pair,) = joint(lower, upper, whole_faces=True)
    slave, master = middles(mesh, pair)
    assert [y for _, y in slave + master] == [1.0] * 10
    assert {len(slave), len(master)} == {2, 8}


def test_glued_bodies_are_told():
    """A crack that ends where its two sides are glued."""
    halves = block(
        "quadrilateral",
        lambda x: np.where(x[:, 1] < 0.5, 1, 2),
        COMM,
        tagged=lambda x: np.isclose(x[:, 1], 0.5) & (x[:, 0] < 0.5),
    )
    cracked = split_interfaces(halves, [Interface((1, 2), (11, 12), facets=9)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert find_contacts(cracked.mesh, cracked.cell_tags) == []
    messages = [str(warning.message) for warning in caught]
    assert COMM.allreduce(sum("1 pairs of bodies" in message for message in messages)) == 1


@pytest.mark.parametrize("distance", [0.0, -1.0, np.nan, "near", True])
def test_wrong_distance(distance):
    made = boxes(COMM, [Box((0, 0), (1, 1), (1, 1))], "quadrilateral")
    with pytest.raises(InputError, match="find_contacts: the distance is"):
        find_contacts(made.mesh, distance=distance)


def test_wrong_word():
    made = boxes(COMM, [Box((0, 0), (1, 1), (1, 1))], "quadrilateral")
    V = displacement_space(made.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(1.0, 0.3)(u), ufl.grad(v)) * ufl.dx
    with pytest.raises(InputError, match="contacts is 'all'.*'auto'"):
        ContactProblem(a, 0.0, contacts="all")


# -- problems ----------------------------------------------------------------------------------

PILE = [Box((0, k), (3, k + 1), (6 + k % 2, 2)) for k in range(3)]


def pile():
    """Return three slabs, meshed differently, with the lowest one fixed and its load."""
    made = boxes(COMM, PILE, "quadrilateral")
    mesh = made.mesh
    V = displacement_space(mesh)
    fixed = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], 0.0))
    markers = []
    for k in (1, 2):
        at = lambda x, k=k: np.isclose(x[1], k)  # noqa: E731
        markers += [(10 * k, at, k), (10 * k + 1, at, k + 1)]
    tags = tag_facets(mesh, markers, made.cell_tags)
    weight = fem.Constant(mesh, np.array([2e-3, -1e-2]))
    return made, V, fem.dirichletbc(np.zeros(2), fixed, V), tags, weight


def test_same_solution_as_with_named_pairs():
    """With friction, in the order and the roles of the pairs that are found."""
    made, V, bc, tags, weight = pile()
    friction = Coulomb(0.5)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(1.0, 0.3)(u), ufl.grad(v)) * ufl.dx
    L = ufl.inner(weight, v) * ufl.dx
    named = [ContactPair(tags, *pair, friction=friction) for pair in ((10, 11), (21, 20))]
    found = find_contacts(made.mesh, made.cell_tags, friction=friction)
    forces, displacements = [], []
    for contacts in (named, found):
        problem = ContactProblem(
            a, L, bcs=bc, contacts=contacts, cell_tags=made.cell_tags, options={"rtol": 1e-10}
        )
        displacements.append(problem.solve().x.array.copy())
        forces.append([contact.force for contact in problem.report.contacts])
    assert np.allclose(forces[0], forces[1], rtol=1e-8, atol=1e-12)
    assert np.allclose(*displacements, rtol=0.0, atol=1e-9 * np.abs(displacements[0]).max())


def test_names_of_bodies_may_be_any_text():
    """The names of pairs have the whole of them."""
    names = ["ring in ring", "ring in bore"]
    parts = [Box((0, k), (1, k + 1), (2, 2), name) for k, name in enumerate(names)]
    made = boxes(COMM, parts, "triangle")
    (pair,) = find_contacts(made.mesh, made.cell_tags)
    assert pair.name == "body 0 (ring in ring) on body 1 (ring in bore)"


def test_auto_in_problems():
    """The problem has the pairs, and the report their names."""
    made, V, bc, _, weight = pile()
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(1.0, 0.3)(u), ufl.grad(v)) * ufl.dx
    L = weight[1] * v[1] * ufl.dx
    problem = ContactProblem(a, L, bcs=bc, contacts="auto")
    problem.solve()
    names = [pair.name for pair in problem.contacts]
    assert len(names) == 2 and all(" on body " in name for name in names)
    assert [entry.name for entry in problem.report.contacts] == names
    assert np.allclose([entry.normal_force for entry in problem.report.contacts], [0.06, 0.03])
    assert problem.report.seconds["contact search"] > 0.0

    w = fem.Function(V)
    energy = neo_hookean(1.0, 0.3)(w) * ufl.dx - weight[1] * w[1] * ufl.dx
    F = ufl.derivative(energy, w, ufl.TestFunction(V))
    side = fem.locate_dofs_geometrical((V.sub(0), V.sub(0).collapse()[0]), lambda x: x[0] < 1e-9)
    held = fem.dirichletbc(fem.Function(V.sub(0).collapse()[0]), side, V.sub(0))
    nonlinear = NonlinearContactProblem(F, w, bcs=[bc, held], contacts="auto")
    nonlinear.solve()
    assert [pair.name for pair in nonlinear.contacts] == names
    forces = [entry.normal_force for entry in nonlinear.report.contacts]
    assert np.allclose(forces, [0.06, 0.03], rtol=1e-3)
