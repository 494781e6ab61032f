"""Pairs of nodes with gaps and areas; partial contacts; contact rows."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from matching import match_contacts
from scenes import CLAMPED, GROUND, LOADED, MASTER, SIDE_X, SLAVE, TRACTION, at, normal_forces
from strips import matched, partners, strips

from fenics_tfeti import Along, ContactPair, Mapped, Nearest, Plane, Points, RigidObstacle, Sphere
from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.conditions.contact_conditions import contact_rows
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.parallel import concatenate_ranks

COMM = MPI.COMM_WORLD

CELLS = ["quadrilateral", "triangle", "hexahedron", "tetrahedron"]


SECOND_MASTER = 16


@pytest.mark.parametrize(
    ("upper", "partners"), [(4, Mapped(lambda x: x - [[0], [0.1], [0]])), (7, None)]
)
def test_tilted_normal_shortens_the_gap(upper, partners):
    """Of pairs of nodes, and of mortar conditions."""
    V, tags = strips((4, 2), (upper, 2), gap=0.1)
    found = matched(V, ContactPair(tags, SLAVE, MASTER, normal=(0.6, -0.8), partners=partners))
    np.testing.assert_allclose(found.normal, np.tile([0.6, -0.8], (upper + 1, 1)))
    np.testing.assert_allclose(found.gap, 0.08, rtol=1e-13)


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
    return tagged, tags, displacement_space(tagged.mesh)


def both(tags):
    return [
        ContactPair(tags, SLAVE, MASTER, name="left", partial=True),
        ContactPair(tags, SLAVE, SECOND_MASTER, name="right", partial=True),
    ]


@pytest.mark.parametrize("cell", CELLS)
def test_partial_contact_counts_the_free_nodes(cell):
    _, tags, V = slab_on_two(MPI.COMM_SELF, cell)
    all_conditions = match_contacts(MeshBoundary.of(V), both(tags))
    summaries = [conditions.summary for conditions in all_conditions]
    rows = 3 if scenes.dimension(cell) == 3 else 1
    assert [entry["pairs"] for entry in summaries] == 2 * [5 * rows]
    assert [entry["unmatched"] for entry in summaries] == 2 * [8 * rows]
    # the areas are those of the masters
    assert [conditions.area.sum() for conditions in all_conditions] == pytest.approx(
        [1.0, 1.0], rel=1e-12
    )


def test_slab_over_two_bodies():
    """Each of the two bodies carries half of the load."""
    tagged, tags, V = slab_on_two(MPI.COMM_SELF)
    scene = scenes.Scene(tagged.mesh, tags, tagged.cell_tags)
    scene.add_load(LOADED, -TRACTION)
    scene.fix(CLAMPED)
    scene.fix(SIDE_X, 0)
    problem = scene.problem(contacts=both(tags), options={"rtol": 1e-10})
    problem.solve()
    forces = normal_forces(problem)
    assert sum(forces) == pytest.approx(3.0 * TRACTION, rel=1e-8)
    assert [c.matching["contact"] for c in problem.report.contacts] == ["left", "right"]
    assert all(force > TRACTION for force in forces)


def test_shared_nodes_of_a_partial_contact_stay_free():
    """The lips of a crack: its tip is slave and master."""
    tagged = boxes(MPI.COMM_SELF, [Box((0, 0), (2, 1), (4, 2))], "quadrilateral")
    tags = tag_facets(
        tagged.mesh, [(SLAVE, lambda x: at(1, 0.0)(x) & (x[0] < 1.01)), (MASTER, at(0, 0.0))]
    )
    V = displacement_space(tagged.mesh)
    # the corner is in both; (0.5, 0) and (1, 0) meet (0, 0.5) and (0, 1) when the corner closes
    folded = {"partners": Mapped(lambda x: x[[1, 0, 2]]), "partial": True}
    x, partner, conditions = partners(V, ContactPair(tags, SLAVE, MASTER, **folded))
    np.testing.assert_allclose(partner, x[:, ::-1], atol=1e-14)
    assert conditions.summary["pairs"] == 2 and conditions.summary["unmatched"] == 1
    with pytest.raises(InputError, match=r"share 1 nodes, the first at \(0, 0\).*partial=True"):
        matched(V, ContactPair(tags, SLAVE, MASTER, partners=Nearest()))


def test_known_obstacle_is_evaluated_again():
    V, tags = strips(gap=0.1)
    height = [0.5]
    floor = RigidObstacle(tags, SLAVE, lambda x: x[1] - height[0])
    boundary = MeshBoundary.of(V)
    known = match_contacts(boundary, [floor])
    height[0] = 0.75
    again = match_contacts(boundary, [floor], [(floor, known[0])], names=["contact 1"])[0]
    np.testing.assert_allclose(again.gap, known[0].gap - 0.25, rtol=1e-14)
    assert again.surface.nodes is known[0].surface.nodes
    assert again.name == again.summary["contact"] == "contact 1"


def test_rows_of_all_contacts_follow_each_other():
    V, tags = strips()
    floor = RigidObstacle(tags, SLAVE, Plane((0.0, 0.5), (0.0, 1.0)))
    contacts = [ContactPair(tags, SLAVE, MASTER), floor]
    rows = contact_rows(match_contacts(MeshBoundary.of(V), contacts), 2)
    assert rows.contact.tolist() == [0] * 5 + [1] * 5
    assert np.diff(rows.offsets).tolist() == [2] * 5 + [1] * 5


def test_gaps_of_touching_surfaces_are_zero_exactly():
    """The surfaces are at 1/3, which no binary number is."""
    parts = [Box((0, 0), (1, 1 / 3), (4, 2)), Box((0, 1 / 3), (1, 1), (4, 2))]
    tagged = boxes(MPI.COMM_SELF, parts, "quadrilateral")
    marks = [(MASTER, at(1, 1 / 3), 1), (SLAVE, at(1, 1 / 3), 2)]
    tags = tag_facets(tagged.mesh, marks, tagged.cell_tags)
    V = displacement_space(tagged.mesh)
    x = V.mesh.geometry.x
    x[np.isclose(x[:, 1], 1 / 3), 1] += 1e-16 * np.random.default_rng(0).integers(-2, 3, 10)
    assert not matched(V, ContactPair(tags, SLAVE, MASTER)).gap.any()


X = np.array([[x, y, 1.1] for x in (1.0, 1.25, 1.5, 1.75, 2.0) for y in (0, 0.25, 0.5, 0.75, 1)])
UP = np.array([0.0, 0.0, 1.0])

ARGUMENTS = {
    "nearest": {},
    "direction": {"partners": Along(UP)},
    "direction at points": {"partners": Along(lambda x: np.tile(UP[:, None], x.shape[1]))},
    "mapping": {"partners": Mapped(lambda x: x - 0.1 * UP[:, None])},
    "points": {"partners": Points(X[::-1], X[::-1] - 0.1 * UP)},
    "partial": {"partners": Points(X[::2], X[::2] - 0.1 * UP), "partial": True},
    "normal": {"normal": lambda x: np.array([0 * x[0], 0.1 * x[1], -x[0]])},
    "moved": {"partners": Mapped(lambda x: x - 0.1 * UP[:, None] + 0.01 * np.sin(9 * x))},
}


def gathered(on, arguments):
    """Match; return the pairs by the slave's coordinates, and the entry of the matching table."""
    scene = scenes.two_beams(on, "hexahedron", 4, gap=0.1)
    conditions = match_contacts(
        MeshBoundary.of(scene.V), [ContactPair(scene.facet_tags, SLAVE, MASTER, **arguments)]
    )[0]
    points = scene.V.tabulate_dof_coordinates()
    own = scene.V.dofmap.index_map.size_local
    node = concatenate_ranks(
        on, scene.V.dofmap.index_map.local_to_global(np.arange(own, dtype="i"))
    )
    place = np.empty((node.size, 3))
    place[node] = concatenate_ranks(on, points[:own])
    columns = [conditions.coordinates, conditions.normal, conditions.gap, conditions.area]
    columns = [concatenate_ranks(on, column) for column in columns]
    columns.append(place[concatenate_ranks(on, conditions.master)])
    order = np.lexsort(np.round(columns[0], 9).T)
    return [column[order] for column in columns], conditions.summary


def rounded(entry):
    return {
        key: float(f"{value:.9g}") if isinstance(value, float) else value
        for key, value in entry.items()
    }


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("way", ARGUMENTS)
def test_pairs_do_not_depend_on_the_ranks(way):
    ours, entry = gathered(COMM, ARGUMENTS[way])
    alone, entry_alone = gathered(MPI.COMM_SELF, ARGUMENTS[way])
    assert len(ours[0]) == (13 if way == "partial" else 25)
    for a, b in zip(ours, alone, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)
    assert rounded(entry) == rounded(entry_alone)
    assert all(other == entry for other in COMM.allgather(entry))


@pytest.mark.ranks(2)
def test_pairing_of_an_obstacle():
    def entry(on):
        scene = scenes.block_on_ball(on, "tetrahedron", 3)
        ball = Sphere((0.4, 0.5, -10.0), 10.0)
        return match_contacts(
            MeshBoundary.of(scene.V), [RigidObstacle(scene.facet_tags, GROUND, ball)]
        )[0].summary

    assert rounded(entry(COMM)) == rounded(entry(MPI.COMM_SELF))


@pytest.mark.ranks(2)
def test_points_that_differ_between_ranks_are_refused():
    scene = scenes.two_beams(COMM, "hexahedron", 4, gap=0.1)
    points = Points(X, X - 0.1 * UP - 1e-9 * COMM.rank)
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, partners=points)
    with pytest.raises(ValueError, match="points differ between ranks"):
        match_contacts(MeshBoundary.of(scene.V), [pair])[0]
