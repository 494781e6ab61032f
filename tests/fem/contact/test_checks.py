"""Checks of contacts pass what is no mistake; tests/test_errors.py has the users' mistakes."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from matching import match_contacts
from scenes import MASTER, SLAVE, at
from strips import bend, matched, strips

from fenics_tfeti import Along, ContactPair, InputError, Mapped, Nearest, Plane, RigidObstacle
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets

SECOND_SLAVE = 15


def pairs_of(space, contacts):
    all_conditions = match_contacts(MeshBoundary.of(space), contacts)
    return [conditions.summary["pairs"] for conditions in all_conditions]


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
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER)
    assert matched(scene.V, pair).summary["pairs"] == 25


def test_new_contact_is_checked_against_those_that_were_found_before():
    scene = scenes.two_beams(MPI.COMM_SELF, "triangle", 2)
    boundary, pair = MeshBoundary.of(scene.V), ContactPair(scene.facet_tags, SLAVE, MASTER)
    known = [(pair, *match_contacts(boundary, [pair]))]
    assert match_contacts(boundary, [pair], known)[0] is known[0][1]
    again = ContactPair(scene.facet_tags, MASTER, SLAVE)
    with pytest.raises(InputError, match="contacts 0 and 1 join the same two surfaces"):
        match_contacts(boundary, [pair, again], known)


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
    V = displacement_space(tagged.mesh)
    contacts = [
        ContactPair(tags, SLAVE, MASTER, partners=Along((0.0, 1.0))),
        ContactPair(tags, SECOND_SLAVE, MASTER, partners=Along((1.0, 0.0))),
    ]
    assert pairs_of(V, contacts) == [5, 3]


def test_equal_tags_of_different_mesh_tags_are_different_surfaces():
    V, tags = strips()
    other = tag_facets(V.mesh, [(MASTER, at(0, 1.0)), (SLAVE, at(0, 0.0))])
    contacts = [
        ContactPair(tags, SLAVE, MASTER),
        ContactPair(other, SLAVE, MASTER, partners=Mapped(lambda x: x + [[1], [0], [0]])),
    ]
    assert pairs_of(V, contacts) == [5, 6]


def test_two_obstacles_at_one_surface_are_allowed():
    V, tags = strips()
    floors = [Plane((0.0, y), (0.0, 1.0)) for y in (0.5, 0.9)]
    contacts = [RigidObstacle(tags, SLAVE, floor) for floor in floors]
    assert pairs_of(V, contacts) == [5, 5]


def test_one_obstacle_twice_at_one_surface_is_allowed():
    V, tags = strips()
    contacts = [RigidObstacle(tags, SLAVE, Plane((0.0, 0.5), (0.0, 1.0))) for _ in range(2)]
    assert pairs_of(V, contacts) == [5, 5]


def test_pairs_in_the_order_of_the_nodes_do_not_cross():
    """The partners of all nodes are far to the right, in the same order."""
    V, tags = strips()
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + [0.5, 0.0, 0.0])
    pair = ContactPair(tags, SLAVE, MASTER, partners=Mapped(lambda x: x - [[0.5], [0.1], [0.0]]))
    assert pairs_of(V, [pair]) == [5]


@pytest.mark.parametrize("tolerance", [0.0, np.nan, np.inf, "wide", None, True])
def test_tolerance_that_is_not_a_positive_number(tolerance):
    with pytest.raises(InputError, match="a positive number is expected"):
        Nearest(tolerance)


def test_interference_fit_is_no_mistake():
    """Two strips of 1 m that overlap by 0.3 m, more than the depth of an element."""
    V, tags = strips((4, 8), (4, 8), gap=-0.3)
    scene = scenes.Scene(V.mesh, tags)
    scene.add_pair(SLAVE, MASTER)
    problem = scene.problem()
    assert problem.system.contacts.gap == pytest.approx(-0.3)
