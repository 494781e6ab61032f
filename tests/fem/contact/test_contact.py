"""Slave nodes, their partners, normals and gaps."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import CLAMPED, LOADED, MASTER, ROLLER, SIDE_X, SLAVE, TRACTION, YOUNG, at

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.matching import match_contact, match_contacts
from fenics_tfeti.fem.contact.surfaces import MeshBoundary
from fenics_tfeti.io import Box, boxes, read_msh, tag_facets

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]
SECOND_SLAVE, SECOND_MASTER = 15, 16


def strips(lower=(4, 2), upper=(4, 2), gap=0.1, comm=MPI.COMM_SELF):
    """Return space and facet tags of two squares, one above the other with a gap; 2D."""
    parts = [Box((0, 0), (1, 1), lower), Box((0, 1 + gap), (1, 2 + gap), upper)]
    tagged = boxes(comm, parts, "triangle")
    marks = [(MASTER, at(1, 1.0), 1), (SLAVE, at(1, 1 + gap), 2)]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    return scenes.vector_space(tagged.mesh), tags


def bend(space, where, move):
    """Move the nodes of a mesh: x[where(x)] = move(x)."""
    x = space.mesh.geometry.x
    chosen = where(x)
    x[chosen] = move(x[chosen])


def ring(outer_radius=2.0, n=8):
    """Return two concentric quarter rings, the inner one's outside the slave, and their tags."""
    V, tags = strips((n, 2), (n, 2), gap=0.5)

    def polar(x):
        # the upper strip inside, so that its slave side faces outwards
        angle, height = 0.5 * np.pi * x[:, 0], x[:, 1]
        radius = np.where(height > 1.2, 2.5 - height, outer_radius + 1.0 - height)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), polar)
    return V, tags


def partners(space, contact):
    """Match, and return slave and partner coordinates, by the slave's."""
    matched = match_contact(MeshBoundary.of(space), contact, 0)
    gdim = space.mesh.geometry.dim
    order = np.lexsort(np.round(matched.coordinates, 12).T[::-1])
    points = space.tabulate_dof_coordinates()[:, :gdim]
    return matched.coordinates[order, :gdim], points[matched.master[order]], matched


# -- ways to find partners -------------------------------------------------------------------------


def ways(V, tags, gap):
    """Return the arguments of all ways to say that partners are `gap` below."""
    up = V.mesh.geometry.dim - 1
    down = np.eye(3)[up] * gap
    slave = match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER), 0).coordinates
    gdim = V.mesh.geometry.dim
    return {
        "nearest": {},
        "direction": {"direction": down[:gdim] / gap},
        "direction at points": {
            "direction": lambda x: -3.0 * np.tile(down[:gdim, None], x.shape[1])
        },
        "mapping": {"mapping": lambda x: x - down[:, None]},
        "pairs": {"pairs": (slave, slave - down)},
    }


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("way", ["nearest", "direction", "direction at points", "mapping", "pairs"])
def test_all_ways_find_the_node_below(cell, way):
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 3, gap=0.1)
    arguments = ways(scene.V, scene.facet_tags, 0.1)[way]
    x, partner, matched = partners(
        scene.V, ContactPair(scene.facet_tags, SLAVE, MASTER, **arguments)
    )
    down = 0.1 * np.eye(x.shape[1])[-1]
    assert len(x) == 4 ** (x.shape[1] - 1)
    np.testing.assert_allclose(partner, x - down, atol=1e-13)
    np.testing.assert_allclose(matched.gap, 0.1, rtol=1e-12)


def test_direction_that_is_not_the_nearest():
    """The master is half an element to the right: along (-1, 2) partners are as numbered."""
    V, tags = strips(gap=0.25)
    bend(V, lambda x: x[:, 1] > 1.1, lambda x: x - [0.125, 0.0, 0.0])
    x, partner, matched = partners(
        V, ContactPair(tags, SLAVE, MASTER, direction=(-1.0, 2.0), tolerance=1e-6)
    )
    np.testing.assert_allclose(partner - x, np.tile([0.125, -0.25], (5, 1)), atol=1e-14)
    np.testing.assert_allclose(matched.gap, 0.25)
    with pytest.raises(InputError, match="5 of 5 slave nodes"):
        match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER), 0)


def radial(x):
    return x[:2]


@pytest.mark.parametrize(
    "arguments",
    [{"direction": radial}, {"mapping": lambda x: x * 2.0}, {"normal": radial}],
    ids=["direction", "mapping", "normal"],
)
def test_concentric_rings_pair_along_the_radius(arguments):
    V, tags = ring()
    x, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, **arguments))
    np.testing.assert_allclose(partner, x * 2.0, atol=1e-13)


def test_direction_finds_the_near_side_of_a_master_all_around():
    """All four sides of the lower square are master: its bottom is on the same lines."""
    V, tags = strips(gap=0.1)
    marks = [(MASTER, lambda x: np.ones(x.shape[1], dtype=bool), 1), (SLAVE, at(1, 1.1), 2)]
    cell_tags = boxes(
        MPI.COMM_SELF, [Box((0, 0), (1, 1), (4, 2)), Box((0, 1.1), (1, 2.1), (4, 2))], "triangle"
    )
    V = scenes.vector_space(cell_tags.mesh)
    tags = tag_facets(cell_tags.mesh, marks, cell_tags.cell_tags)
    _, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, direction=(0.0, 1.0)))
    np.testing.assert_allclose(partner[:, 1], 1.0)


def test_direction_takes_the_nearer_of_two_sheets():
    """Two slabs below the slave, both master, with normals upwards."""
    parts = [Box((0, y), (1, y + 0.5), (4, 2)) for y in (0.0, 1.0, 1.6)]
    tagged = boxes(MPI.COMM_SELF, parts, "quadrilateral")
    marks = [(MASTER, at(1, 0.5), 1), (MASTER, at(1, 1.5), 2), (SLAVE, at(1, 1.6), 3)]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = scenes.vector_space(tagged.mesh)
    # the far sheet is exactly below, the near one misses a little
    bend(V, lambda x: (x[:, 1] > 0.9) & (x[:, 1] < 1.55), lambda x: x + [0.01, 0.0, 0.0])
    _, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, direction=(0.0, -1.0)))
    np.testing.assert_allclose(partner[:, 1], 1.5)


def test_mapping_between_surfaces_that_do_not_face_each_other():
    """chi may turn: the slave's bottom touches the master's right side, once folded up."""
    tagged = boxes(
        MPI.COMM_SELF, [Box((0, 0), (1, 1), (2, 4)), Box((3, 0), (4, 1), (4, 2))], "quadrilateral"
    )
    tags = tag_facets(
        tagged.mesh, [(MASTER, at(0, 1.0), 1), (SLAVE, at(1, 0.0), 2)], tagged.cell_tags
    )
    V = scenes.vector_space(tagged.mesh)
    x, partner, _ = partners(
        V,
        ContactPair(
            tags, SLAVE, MASTER, mapping=lambda x: np.array([1 + x[1], x[0] - 3, 0 * x[2]])
        ),
    )
    np.testing.assert_allclose(partner, np.stack([1 + x[:, 1], x[:, 0] - 3], axis=1), atol=1e-14)


def test_pairs_may_be_rounded_and_in_any_order():
    V, tags = strips()
    x = np.array([[0.5, 1.1], [0.0, 1.1], [1.0, 1.1], [0.25, 1.1], [0.75, 1.1]])
    rounded = x + 1e-3 * np.array([1.0, -1.0])
    pair = ContactPair(tags, SLAVE, MASTER, pairs=(rounded, x - [0.0, 0.1]))
    x, partner, matched = partners(V, pair)
    np.testing.assert_allclose(partner, x - [0.0, 0.1], atol=1e-14)
    assert matched.summary["largest_distance"] == pytest.approx(np.sqrt(2) * 1e-3)


# -- tolerance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["nearest", "direction", "direction at points", "mapping", "pairs"])
def test_micrometres_give_the_pairs_of_metres(way):
    numbers = []
    for metre in (1.0, 1e-6):
        scene = scenes.two_beams(MPI.COMM_SELF, "triangle", 4, gap=0.1, metre=metre)
        slave = scene.V.mesh.geometry.x[:, 1] > 1.05 * metre
        bend(scene.V, lambda x, s=slave: s, lambda x, m=metre: x + [0.02 * m, 0, 0])
        wide = ContactPair(scene.facet_tags, SLAVE, MASTER, tolerance=0.09)
        x = match_contact(MeshBoundary.of(scene.V), wide, 0).coordinates
        arguments = {
            "nearest": {},
            "direction": {"direction": (0.0, 1.0)},
            "direction at points": {"direction": lambda x: np.tile([[0.0], [1.0]], x.shape[1])},
            "mapping": {"mapping": lambda x, m=metre: x - [[0], [0.1 * m], [0]]},
            "pairs": {"pairs": (x, x - [0, 0.1 * metre, 0])},
        }[way]
        matched = match_contact(
            MeshBoundary.of(scene.V),
            ContactPair(scene.facet_tags, SLAVE, MASTER, tolerance=0.09, **arguments),
            0,
        )
        numbers.append((matched.slave.tolist(), matched.master.tolist()))
        with pytest.raises(InputError, match="5 (of 5 slave nodes|pairs)"):
            match_contact(
                MeshBoundary.of(scene.V),
                ContactPair(scene.facet_tags, SLAVE, MASTER, tolerance=0.07, **arguments),
                0,
            )
    assert numbers[0] == numbers[1]


def test_tolerance_is_relative_to_the_local_facets():
    """The slave's facets are 0.05 to 0.65 long, and all nodes 0.008 from their partners."""
    V, tags = strips(gap=0.1)

    def grade(x):
        places = np.interp(x[:, 0], [0, 0.25, 0.5, 0.75, 1.0], [0, 0.05, 0.15, 0.35, 1.0])
        return np.stack([places + 0.008 * (x[:, 1] > 1.05), x[:, 1], x[:, 2]], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), grade)
    matched = match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER, partial=True), 0)
    assert sorted(np.round(matched.coordinates[:, 0], 12)) == [0.158, 0.358, 1.008]
    assert matched.summary["unmatched"] == 2
    assert matched.summary["largest_relative_distance"] == pytest.approx(0.08)


def test_meshes_that_correspond_but_are_not_identical():
    """Nodes moved at random by up to a quarter of an element each are no crossing pairs."""
    scene = scenes.two_beams(MPI.COMM_SELF, "tetrahedron", 4)
    random = np.random.default_rng(1)
    bend(
        scene.V,
        lambda x: np.isclose(x[:, 2], 1.0),
        lambda x: (
            x + np.append(0.06 * random.uniform(-1, 1, (len(x), 2)), np.zeros((len(x), 1)), 1)
        ),
    )
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, tolerance=0.9)
    assert match_contact(MeshBoundary.of(scene.V), pair, 0).summary["pairs"] == 25


# -- meshes by gmsh --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gmsh_beams(tmp_path_factory):
    """The demo's beams with few unstructured tetrahedra, alike on the contact faces."""
    pytest.importorskip("gmsh")
    path = Path(__file__).parents[3] / "meshes" / "two_beams.py"
    spec = importlib.util.spec_from_file_location("two_beams_mesh", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    file = tmp_path_factory.mktemp("mesh") / "beams.msh"
    module.two_beams(file, "tetrahedron", 4)
    beams = read_msh(file, MPI.COMM_SELF)
    names = beams.names
    return scenes.vector_space(beams.mesh), beams.facet_tags, names


@pytest.mark.parametrize(
    "arguments",
    [{}, {"direction": (0, 0, 1)}, {"mapping": lambda x: x}],
    ids=["nearest", "direction", "mapping"],
)
def test_unstructured_faces_that_are_alike(gmsh_beams, arguments):
    V, tags, names = gmsh_beams
    pair = ContactPair(tags, names["contact_upper"], names["contact_lower"], **arguments)
    x, partner, matched = partners(V, pair)
    np.testing.assert_allclose(partner, x, atol=1e-13)
    assert matched.summary["unmatched"] == 0
    assert matched.area.sum() == pytest.approx(1.0, rel=1e-12)


def test_surfaces_that_nobody_meshed_alike():
    """17 slave nodes on 12 master nodes: a partial contact takes those near enough, no others."""
    V, tags = strips((11, 3), (16, 3), gap=0.05)
    with pytest.raises(InputError, match=r"15 of 17 slave nodes have no partner"):
        match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER, tolerance=1e-3), 0)
    matched = match_contact(
        MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER, tolerance=0.5, partial=True), 0
    )
    i, j = np.arange(17), np.arange(12)
    misses = np.abs(i[:, None] / 16 - j / 11).min(axis=1) * 16
    assert matched.summary["pairs"] == np.sum(misses <= 0.5) == 12
    assert matched.summary["unmatched"] == 5
    assert matched.summary["largest_relative_distance"] == pytest.approx(
        misses[misses <= 0.5].max()
    )


@pytest.mark.parametrize("way", [{}, {"direction": (0.0, 0.0, 1.0)}], ids=["nearest", "direction"])
def test_unstructured_faces_that_nobody_meshed_alike(tmp_path, way):
    """All slave nodes over the finer master find a node of it, those over its rim stay free."""
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        occ, mesh = gmsh.model.occ, gmsh.model.mesh
        bodies = [occ.addBox(0, 0, 0, 1, 1, 0.5), occ.addBox(-0.25, 0.1, 0.5, 1.5, 0.8, 0.5)]
        occ.synchronize()
        for body, tag, size in zip(bodies, (MASTER, SLAVE), (0.07, 0.2), strict=True):
            gmsh.model.addPhysicalGroup(3, [body], body)
            faces = [face for _, face in gmsh.model.getBoundary([(3, body)], oriented=False)]
            touching = [f for f in faces if abs(occ.getCenterOfMass(2, f)[2] - 0.5) < 1e-9]
            gmsh.model.addPhysicalGroup(2, touching, tag)
            mesh.setSize(gmsh.model.getBoundary([(3, body)], recursive=True), size)
        mesh.generate(3)
        gmsh.write(str(tmp_path / "blocks.msh"))
    finally:
        gmsh.finalize()
    blocks = read_msh(tmp_path / "blocks.msh", MPI.COMM_SELF)
    V = scenes.vector_space(blocks.mesh)
    pair = ContactPair(blocks.facet_tags, SLAVE, MASTER, tolerance=0.5, partial=True, **way)
    x, partner, matched = partners(V, pair)
    points = V.tabulate_dof_coordinates()
    slave, master = (
        points[fem.locate_dofs_topological(V, 2, blocks.facet_tags.find(tag))]
        for tag in (SLAVE, MASTER)
    )
    over = np.sum((slave[:, 0] > -1e-9) & (slave[:, 0] < 1 + 1e-9))
    assert over <= len(x) < len(slave)
    assert matched.summary["unmatched"] == len(slave) - len(x)
    distance = np.linalg.norm(x[:, None] - master, axis=2)
    np.testing.assert_allclose(np.linalg.norm(x - partner, axis=1), distance.min(axis=1))
    assert len(np.unique(np.round(partner, 9), axis=0)) == len(x)


# -- partial contacts ------------------------------------------------------------------------------


def slab_on_two(comm, cell="quadrilateral"):
    """Two blocks side by side with a gap between, a slab over both; all on one scene.

    Returns mesh parts and the tags SLAVE, MASTER (left), SECOND_MASTER (right), LOADED (top).
    """
    gdim = scenes.dimension(cell)

    def box(lower, upper, n):
        deep = ((0,), (1,), (2,)) if gdim == 3 else ((), (), ())
        return Box(
            (lower[0], *deep[0], lower[1]), (upper[0], *deep[1], upper[1]), (n[0], *deep[2], n[1])
        )

    parts = [
        box((0, 0), (1, 1), (4, 2)),
        box((2, 0), (3, 1), (4, 2)),
        box((0, 1), (3, 1.5), (12, 2)),
    ]
    tagged = boxes(comm, parts, cell)
    up = gdim - 1
    tags = tag_facets(
        tagged.mesh,
        [
            (CLAMPED, at(up, 0.0)),
            (MASTER, at(up, 1.0), 1),
            (SECOND_MASTER, at(up, 1.0), 2),
            (SLAVE, at(up, 1.0), 3),
            (LOADED, at(up, 1.5), 3),
            (SIDE_X, at(0, 0.0), 3),
        ],
        tagged.cell_tags,
    )
    return tagged, tags, scenes.vector_space(tagged.mesh)


def both(tags):
    return [
        ContactPair(tags, SLAVE, MASTER, name="left", partial=True),
        ContactPair(tags, SLAVE, SECOND_MASTER, name="right", partial=True),
    ]


@pytest.mark.parametrize("cell", CELLS)
def test_partial_contact_counts_the_free_nodes(cell):
    _, tags, V = slab_on_two(MPI.COMM_SELF, cell)
    pairing = [matched.summary for matched in match_contacts(MeshBoundary.of(V), both(tags))]
    rows = 3 if scenes.dimension(cell) == 3 else 1
    assert [entry["pairs"] for entry in pairing] == [5 * rows, 5 * rows]
    assert [entry["unmatched"] for entry in pairing] == [8 * rows, 8 * rows]


@pytest.mark.parametrize("cell", CELLS)
def test_area_of_a_partial_contact_is_that_of_the_master(cell):
    _, tags, V = slab_on_two(MPI.COMM_SELF, cell)
    for matched in match_contacts(MeshBoundary.of(V), both(tags)):
        assert matched.area.sum() == pytest.approx(1.0, rel=1e-12)


def test_nodes_are_errors_where_the_contact_is_not_partial():
    _, tags, V = slab_on_two(MPI.COMM_SELF)
    with pytest.raises(InputError, match=r"8 of 13 slave nodes .*partial=True"):
        match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER), 0)


def test_slab_over_two_bodies():
    """Each of the two bodies carries half of the load."""
    tagged, tags, V = slab_on_two(MPI.COMM_SELF)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, load = fem.Constant(tagged.mesh, YOUNG), fem.Constant(tagged.mesh, -TRACTION)
    ds = ufl.Measure("ds", domain=tagged.mesh, subdomain_data=tags)
    bcs = [scenes.fixed(V, tags, CLAMPED, None), scenes.fixed(V, tags, SIDE_X, 0)]
    problem = ContactProblem(
        scenes.elasticity(u, v, young),
        load * v[1] * ds(LOADED),
        bcs,
        both(tags),
        tagged.cell_tags,
        options={"rtol": 1e-10},
    )
    problem.solve()
    assert sum(problem.report.contact_force) == pytest.approx(3.0 * TRACTION, rel=1e-8)
    assert [entry["contact"] for entry in problem.report.pairing] == ["left", "right"]
    assert all(force > TRACTION for force in problem.report.contact_force)


def test_body_that_is_slave_of_one_and_master_of_another():
    """Three loose blocks on each other: all carry the load on the top."""
    parts = [Box((0, y), (1, y + 1), (3, 3)) for y in (0, 1, 2)]
    tagged = boxes(MPI.COMM_SELF, parts, "quadrilateral")
    tags = tag_facets(
        tagged.mesh,
        [
            (CLAMPED, at(1, 0.0), 1),
            (MASTER, at(1, 1.0), 1),
            (SLAVE, at(1, 1.0), 2),
            (SECOND_MASTER, at(1, 2.0), 2),
            (SECOND_SLAVE, at(1, 2.0), 3),
            (LOADED, at(1, 3.0), 3),
            (SIDE_X, lambda x: np.isclose(x[0], 0.0) & (x[1] > 0.9), 2),
            (ROLLER, lambda x: np.isclose(x[0], 0.0) & (x[1] > 1.9), 3),
        ],
        tagged.cell_tags,
    )
    V = scenes.vector_space(tagged.mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    young, load = fem.Constant(tagged.mesh, YOUNG), fem.Constant(tagged.mesh, -TRACTION)
    ds = ufl.Measure("ds", domain=tagged.mesh, subdomain_data=tags)
    contacts = [ContactPair(tags, SLAVE, MASTER), ContactPair(tags, SECOND_SLAVE, SECOND_MASTER)]
    bcs = [scenes.fixed(V, tags, CLAMPED, 1)]
    bcs += [scenes.fixed(V, tags, tag, 0) for tag in (CLAMPED, SIDE_X, ROLLER)]
    problem = ContactProblem(
        scenes.elasticity(u, v, young),
        load * v[1] * ds(LOADED),
        bcs,
        contacts,
        tagged.cell_tags,
        options={"rtol": 1e-10},
    )
    problem.solve()
    assert problem.report.contact_force == pytest.approx([TRACTION, TRACTION], rel=1e-8)


def test_shared_nodes_of_a_partial_contact_stay_free():
    """The lips of a crack: its tip is slave and master."""
    tagged = boxes(MPI.COMM_SELF, [Box((0, 0), (2, 1), (4, 2))], "quadrilateral")
    tags = tag_facets(
        tagged.mesh, [(SLAVE, lambda x: at(1, 0.0)(x) & (x[0] < 1.01)), (MASTER, at(0, 0.0))]
    )
    V = scenes.vector_space(tagged.mesh)
    # the corner is in both; (0.5, 0) and (1, 0) meet (0, 0.5) and (0, 1) when the corner closes
    folded = {"mapping": lambda x: x[[1, 0, 2]], "partial": True}
    x, partner, matched = partners(V, ContactPair(tags, SLAVE, MASTER, **folded))
    np.testing.assert_allclose(partner, x[:, ::-1], atol=1e-14)
    assert matched.summary["pairs"] == 2 and matched.summary["unmatched"] == 1
    with pytest.raises(InputError, match=r"share 1 nodes, the first at \(0, 0\).*partial=True"):
        match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER), 0)


# -- normals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [(0.0, -3.0), lambda x: -np.array([0 * x[0], 1 + x[0]])])
def test_normals_are_scaled_to_unit_length(given):
    V, tags = strips()
    matched = match_contact(MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER, normal=given), 0)
    np.testing.assert_allclose(matched.normal, np.tile([0.0, -1.0], (5, 1)), atol=1e-15)


def test_analytic_normals_of_a_polygon():
    V, tags = ring()
    _, _, matched = partners(V, ContactPair(tags, SLAVE, MASTER, normal=radial))
    np.testing.assert_allclose(matched.normal, matched.coordinates[:, :2], atol=1e-14)
    np.testing.assert_allclose(matched.gap, 1.0, rtol=1e-13)


def test_averaged_normals_of_a_polygon():
    """Inside they are the radius, at the two ends the normal of the last facet."""
    V, tags = ring(n=8)
    _, _, matched = partners(V, ContactPair(tags, SLAVE, MASTER, mapping=lambda x: 2 * x))
    x, n = matched.coordinates.T, matched.normal.T
    sine = np.abs(n[0] * x[1] - n[1] * x[0])
    np.testing.assert_allclose(np.sort(sine)[-2:], np.sin(np.pi / 32), rtol=1e-12)
    np.testing.assert_allclose(np.sort(sine)[:-2], 0.0, atol=1e-15)


def test_tilted_normal_shortens_the_gap():
    V, tags = strips(gap=0.1)
    pair = ContactPair(
        tags, SLAVE, MASTER, normal=(0.6, -0.8), mapping=lambda x: x - [[0], [0.1], [0]]
    )
    np.testing.assert_allclose(match_contact(MeshBoundary.of(V), pair, 0).gap, 0.08, rtol=1e-13)


# -- what is reported ------------------------------------------------------------------------------


def test_pairing_entry():
    """The slave is tilted by 45 degrees about (0, 1.1), and turned back by its given normal."""
    V, tags = strips(gap=0.1)
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + np.outer(x[:, 0], [0.0, 1.0, 0.0]))
    mapping = {"mapping": lambda x: np.array([x[0] + 0.01, 1 + 0 * x[1], x[2]])}
    entry = match_contact(
        MeshBoundary.of(V), ContactPair(tags, SLAVE, MASTER, name="a", **mapping), 0
    ).summary
    assert entry == {
        "contact": "a",
        "pairs": 5,
        "unmatched": 0,
        "largest_distance": pytest.approx(0.01),
        "largest_relative_distance": pytest.approx(0.01 / (0.25 * np.sqrt(2))),
        "largest_angle": pytest.approx(45.0),
        "smallest_gap": pytest.approx(0.1 / np.sqrt(2)),
        "largest_gap": pytest.approx(1.1 / np.sqrt(2)),
    }


def test_report_has_the_pairing(tmp_path):
    import json

    scene = scenes.two_beams(MPI.COMM_SELF, "quadrilateral", 3)
    problem = scene.problem()
    problem.solve()
    problem.report.to_json(tmp_path / "report.json")
    written = json.loads((tmp_path / "report.json").read_text())["pairing"]
    assert written == problem.report.pairing
    head, line = problem.report.pairing_table().splitlines()
    assert head.split()[:3] == ["contact", "pairs", "unmatched"]
    assert line.split() == ["contact", "0", "(pair)", "4", "0", "0", "0", "0", "0", "0"]


# -- several contacts ------------------------------------------------------------------------------


def test_edge_node_meets_one_surface_from_two_sides():
    """A block in a corner that is one surface: the edge is in the way in two directions."""
    tagged = boxes(
        MPI.COMM_SELF,
        [Box((0, 0), (2, 1), (4, 2)), Box((-1, -1), (0, 1), (2, 4)), Box((0, -1), (2, 0), (4, 2))],
        "quadrilateral",
    )
    tags = tag_facets(
        tagged.mesh,
        [
            (SLAVE, at(1, 0.0), 1),
            (SECOND_SLAVE, at(0, 0.0), 1),
            (MASTER, lambda x: np.isclose(x[0], 0.0) & (x[1] > -0.01), 2),
            (MASTER, at(1, 0.0), 3),
        ],
        tagged.cell_tags,
    )
    V = scenes.vector_space(tagged.mesh)
    contacts = [
        ContactPair(tags, SLAVE, MASTER, direction=(0.0, 1.0)),
        ContactPair(tags, SECOND_SLAVE, MASTER, direction=(1.0, 0.0)),
    ]
    assert [m.summary["pairs"] for m in match_contacts(MeshBoundary.of(V), contacts)] == [5, 3]


def test_equal_tags_of_different_mesh_tags_are_different_surfaces():
    V, tags = strips()
    other = tag_facets(V.mesh, [(MASTER, at(0, 1.0)), (SLAVE, at(0, 0.0))])
    contacts = [
        ContactPair(tags, SLAVE, MASTER),
        ContactPair(other, SLAVE, MASTER, mapping=lambda x: x + [[1], [0], [0]]),
    ]
    assert [m.summary["pairs"] for m in match_contacts(MeshBoundary.of(V), contacts)] == [5, 6]
