"""The four ways to find partners, the tolerance, and meshes that do not match."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import MASTER, SLAVE, at
from strips import bend, matched, partners, ring, strips

from dolfinx import fem

from fenics_tfeti import Along, ContactPair, Mapped, Nearest, Points
from fenics_tfeti.errors import InputError
from fenics_tfeti.io import Box, boxes, displacement_space, read_msh, tag_facets

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]


def way_to_find(way, slave, down, tolerance=0.1):
    """Return partners in one of all ways; they are `down` from the slave's coordinates."""
    gdim = int(np.flatnonzero(down)[0]) + 1
    direction = down[:gdim] / np.linalg.norm(down)
    return {
        "nearest": Nearest(tolerance),
        "direction": Along(direction, tolerance),
        "direction at points": Along(
            lambda x: -3.0 * np.tile(direction[:, None], x.shape[1]), tolerance
        ),
        "mapping": Mapped(lambda x: x + down[:, None], tolerance),
        "points": Points(slave, slave + down, tolerance),
    }[way]


every_way = pytest.mark.parametrize(
    "way", ["nearest", "direction", "direction at points", "mapping", "points"]
)


@pytest.mark.parametrize("cell", CELLS)
@every_way
def test_all_ways_find_the_node_below(cell, way):
    scene = scenes.two_beams(MPI.COMM_SELF, cell, 3, gap=0.1)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER)
    down = -0.1 * np.eye(3)[scene.V.mesh.geometry.dim - 1]
    how = way_to_find(way, matched(scene.V, pair).coordinates, down)
    x, partner, conditions = partners(scene.V, replace(pair, partners=how))
    down = 0.1 * np.eye(x.shape[1])[-1]
    assert len(x) == 4 ** (x.shape[1] - 1)
    np.testing.assert_allclose(partner, x - down, atol=1e-13)
    np.testing.assert_allclose(conditions.gap, 0.1, rtol=1e-12)


def test_direction_that_is_not_the_nearest():
    """The master is half an element to the right: along (-1, 2) partners are as numbered."""
    V, tags = strips(gap=0.25)
    bend(V, lambda x: x[:, 1] > 1.1, lambda x: x - [0.125, 0.0, 0.0])
    x, partner, conditions = partners(
        V, ContactPair(tags, SLAVE, MASTER, partners=Along((-1.0, 2.0), 1e-6))
    )
    np.testing.assert_allclose(partner - x, np.tile([0.125, -0.25], (5, 1)), atol=1e-14)
    np.testing.assert_allclose(conditions.gap, 0.25)
    with pytest.raises(InputError, match="5 of 5 slave nodes"):
        matched(V, ContactPair(tags, SLAVE, MASTER, partners=Nearest()))


def radial(x):
    return x[:2]


@pytest.mark.parametrize(
    "arguments",
    [{"partners": Along(radial)}, {"partners": Mapped(lambda x: x * 2.0)}, {"normal": radial}],
    ids=["direction", "mapping", "normal"],
)
def test_concentric_rings_pair_along_the_radius(arguments):
    V, tags = ring()
    x, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, **arguments))
    np.testing.assert_allclose(partner, x * 2.0, atol=1e-13)


def test_direction_finds_the_near_side_of_a_master_all_around():
    """All four sides of the lower square are master: its bottom is on the same lines."""
    marks = [(MASTER, lambda x: np.ones(x.shape[1], dtype=bool), 1), (SLAVE, at(1, 1.1), 2)]
    cell_tags = boxes(
        MPI.COMM_SELF, [Box((0, 0), (1, 1), (4, 2)), Box((0, 1.1), (1, 2.1), (4, 2))], "triangle"
    )
    V = displacement_space(cell_tags.mesh)
    tags = tag_facets(cell_tags.mesh, marks, cell_tags.cell_tags)
    _, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, partners=Along((0.0, 1.0))))
    np.testing.assert_allclose(partner[:, 1], 1.0)


def test_direction_takes_the_nearer_of_two_sheets():
    """Two slabs below the slave, both master, with normals upwards."""
    parts = [Box((0, y), (1, y + 0.5), (4, 2)) for y in (0.0, 1.0, 1.6)]
    tagged = boxes(MPI.COMM_SELF, parts, "quadrilateral")
    marks = [(MASTER, at(1, 0.5), 1), (MASTER, at(1, 1.5), 2), (SLAVE, at(1, 1.6), 3)]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = displacement_space(tagged.mesh)
    # the far sheet is exactly below, the near one misses a little
    bend(V, lambda x: (x[:, 1] > 0.9) & (x[:, 1] < 1.55), lambda x: x + [0.01, 0.0, 0.0])
    _, partner, _ = partners(V, ContactPair(tags, SLAVE, MASTER, partners=Along((0.0, -1.0))))
    np.testing.assert_allclose(partner[:, 1], 1.5)


def test_mapping_between_surfaces_that_do_not_face_each_other():
    """chi may turn: the slave's bottom touches the master's right side, once folded up."""
    tagged = boxes(
        MPI.COMM_SELF, [Box((0, 0), (1, 1), (2, 4)), Box((3, 0), (4, 1), (4, 2))], "quadrilateral"
    )
    tags = tag_facets(
        tagged.mesh, [(MASTER, at(0, 1.0), 1), (SLAVE, at(1, 0.0), 2)], tagged.cell_tags
    )
    V = displacement_space(tagged.mesh)
    x, partner, _ = partners(
        V,
        ContactPair(
            tags, SLAVE, MASTER, partners=Mapped(lambda x: np.array([1 + x[1], x[0] - 3, 0 * x[2]]))
        ),
    )
    np.testing.assert_allclose(partner, np.stack([1 + x[:, 1], x[:, 0] - 3], axis=1), atol=1e-14)


def test_pairs_may_be_rounded_and_in_any_order():
    V, tags = strips()
    x = np.array([[0.5, 1.1], [0.0, 1.1], [1.0, 1.1], [0.25, 1.1], [0.75, 1.1]])
    rounded = x + 1e-3 * np.array([1.0, -1.0])
    pair = ContactPair(tags, SLAVE, MASTER, partners=Points(rounded, x - [0.0, 0.1]))
    x, partner, conditions = partners(V, pair)
    np.testing.assert_allclose(partner, x - [0.0, 0.1], atol=1e-14)
    assert conditions.summary["largest_distance"] == pytest.approx(np.sqrt(2) * 1e-3)


@every_way
def test_micrometres_give_the_pairs_of_metres(way):
    numbers = []
    for metre in (1.0, 1e-6):
        scene = scenes.two_beams(MPI.COMM_SELF, "triangle", 4, gap=0.1, metre=metre)
        slave = scene.V.mesh.geometry.x[:, 1] > 1.05 * metre
        bend(scene.V, lambda x, s=slave: s, lambda x, m=metre: x + [0.02 * m, 0, 0])
        pair = ContactPair(scene.facet_tags, SLAVE, MASTER, partners=Nearest(0.09))
        x, down = matched(scene.V, pair).coordinates, np.array([0.0, -0.1 * metre, 0.0])
        near = replace(pair, partners=way_to_find(way, x, down, 0.09))
        conditions = matched(scene.V, near)
        numbers.append((conditions.slave.tolist(), conditions.master.tolist()))
        with pytest.raises(InputError, match="5 (of 5 slave nodes|pairs)"):
            matched(scene.V, replace(pair, partners=way_to_find(way, x, down, 0.07)))
    assert numbers[0] == numbers[1]


def test_tolerance_is_relative_to_the_local_facets():
    """The slave's facets are 0.05 to 0.65 long, and all nodes 0.008 from their partners."""
    V, tags = strips(gap=0.1)

    def grade(x):
        places = np.interp(x[:, 0], [0, 0.25, 0.5, 0.75, 1.0], [0, 0.05, 0.15, 0.35, 1.0])
        return np.stack([places + 0.008 * (x[:, 1] > 1.05), x[:, 1], x[:, 2]], axis=1)

    bend(V, lambda x: np.ones(len(x), dtype=bool), grade)
    conditions = matched(V, ContactPair(tags, SLAVE, MASTER, partners=Nearest(), partial=True))
    assert sorted(np.round(conditions.coordinates[:, 0], 12)) == [0.158, 0.358, 1.008]
    assert conditions.summary["unmatched"] == 2
    assert conditions.summary["largest_relative_distance"] == pytest.approx(0.08)


def test_surfaces_that_nobody_meshed_alike():
    """17 slave nodes on 12 master nodes: a partial contact takes those near enough, no others."""
    V, tags = strips((11, 3), (16, 3), gap=0.05)
    with pytest.raises(InputError, match=r"15 of 17 slave nodes have no partner"):
        matched(V, ContactPair(tags, SLAVE, MASTER, partners=Nearest(1e-3)))
    conditions = matched(V, ContactPair(tags, SLAVE, MASTER, partners=Nearest(0.5), partial=True))
    i, j = np.arange(17), np.arange(12)
    misses = np.abs(i[:, None] / 16 - j / 11).min(axis=1) * 16
    assert conditions.summary["pairs"] == np.sum(misses <= 0.5) == 12
    assert conditions.summary["unmatched"] == 5
    assert conditions.summary["largest_relative_distance"] == pytest.approx(
        misses[misses <= 0.5].max()
    )


@pytest.mark.parametrize(
    "way", [Nearest(0.5), Along((0.0, 0.0, 1.0), 0.5)], ids=["nearest", "direction"]
)
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
    V = displacement_space(blocks.mesh)
    pair = ContactPair(blocks.facet_tags, SLAVE, MASTER, partners=way, partial=True)
    x, partner, conditions = partners(V, pair)
    points = V.tabulate_dof_coordinates()
    slave, master = (
        points[fem.locate_dofs_topological(V, 2, blocks.facet_tags.find(tag))]
        for tag in (SLAVE, MASTER)
    )
    over = np.sum((slave[:, 0] > -1e-9) & (slave[:, 0] < 1 + 1e-9))
    assert over <= len(x) < len(slave)
    assert conditions.summary["unmatched"] == len(slave) - len(x)
    distance = np.linalg.norm(x[:, None] - master, axis=2)
    np.testing.assert_allclose(np.linalg.norm(x - partner, axis=1), distance.min(axis=1))
    assert len(np.unique(np.round(partner, 9), axis=0)) == len(x)
