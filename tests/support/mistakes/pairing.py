"""Mistakes in the pairing of slave and master nodes, and in normals."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import scenes
from scenes import CLAMPED, LOADED, MASTER, ROLLER, SLAVE, at

from fenics_tfeti import Along, ContactPair, Exact, Mapped, Nearest, Points
from fenics_tfeti.fem import _compat
from fenics_tfeti.io import tag_facets
from mistakes.catalogue import beams, mistake

# the slave's nodes of beams()
PLACES = np.array([[1.0, 1.0, 0.0], [1.25, 1, 0], [1.5, 1, 0], [1.75, 1, 0], [2.0, 1, 0]])


def two_blocks(comm: MPI.Comm, cell: str, upper: tuple[int, int]) -> scenes.Scene:
    """Two unit blocks, one on the other, the lower one of 4 x 4 elements."""
    marks = [(CLAMPED, at(1, 0.0), 1), (ROLLER, at(1, 2.0), 2)]
    marks += [(MASTER, at(1, 1.0), 1), (SLAVE, at(1, 1.0), 2)]
    parts = [((0, 0), (1, 1), (4, 4)), ((0, 1), (1, 2), upper)]
    scene = scenes.Scene.of_boxes(comm, cell, parts, marks)
    scene.fix(CLAMPED)
    scene.fix(ROLLER)
    return scene


def non_matching(comm: MPI.Comm) -> scenes.Scene:
    """The blocks with 4 and 3 elements along the contact: the two inner slave nodes miss."""
    return two_blocks(comm, "quadrilateral", (3, 4))


@mistake("2 of 4 slave nodes", r"\(0\.333333, 1\) at distance 0\.0833", "toleran")
def slave_nodes_without_partner(comm):
    mortar(comm, partners=Nearest())


def joined(scene: scenes.Scene, geometry=None, **arguments) -> None:
    """Solve with the contact between slave and master as described."""
    scene.contacts = []
    scene.add_pair(name="joint", **arguments)
    scene.problem(geometry=geometry).solve()


def paired(comm: MPI.Comm, partners=None, normal=None) -> None:
    joined(beams(comm), partners=partners, normal=normal)


def mortar(comm: MPI.Comm, **arguments) -> None:
    """Solve for the blocks whose meshes do not match."""
    joined(non_matching(comm), **arguments)


@mistake("joint: partners is 'nts'", r"Nearest\(\)", "'mortar' or None")
def unknown_partners(comm):
    paired(comm, "nts")


@mistake("Nearest: the tolerance", "-0.1", "positive")
def tolerance_that_is_negative(comm):
    paired(comm, Nearest(tolerance=-0.1))


@mistake("joint", "direction", r"\(3,\)", r"\(2,\)")
def direction_of_a_wrong_shape(comm):
    paired(comm, Along((0.0, 0.0, 1.0)))


@mistake("Along: the direction", "no direction")
def direction_of_no_length(comm):
    paired(comm, Along((0.0, 0.0)))


@mistake("joint", "direction", "vanishes", "1 points", r"\(1\.5, 1\)")
def direction_that_vanishes_somewhere(comm):
    paired(comm, Along(lambda x: x[:2] - np.array([[1.5], [1.0]])))


@mistake("joint", r"5 of 5 slave nodes have no partner", r"\(1, 1\.1\) at dist", "across the dir")
def direction_that_misses(comm):
    scene = scenes.two_beams(comm, "quadrilateral", 4, gap=0.1)
    joined(scene, partners=Along((1.0, -1.0)))


@mistake("Mapped: the mapping", "function")
def mapping_that_is_no_function(comm):
    paired(comm, Mapped((0.0, 1.0)))


@mistake("joint", "mapping", "shape", r"expected \(2, \d\)")
def mapping_of_a_wrong_shape(comm):
    paired(comm, Mapped(lambda x: x[0]))


@mistake("joint", "mapping", "NaN", "1 points", r"\(1\.25, 1\)")
def mapping_that_is_nan_somewhere(comm):
    paired(comm, Mapped(lambda x: np.where(np.isclose(x[0], 1.25), np.nan, x)))


@mistake("joint", "mapping", "KeyError", "chi")
def mapping_that_fails(comm):
    paired(comm, Mapped(lambda x: {}["chi"]))


@mistake("joint", r"4 of 5 slave nodes", r"\(1, 1\) at distance 0.125", "mapped", "0.5", "toleran")
def mapping_that_misses_the_nodes(comm):
    paired(comm, Mapped(lambda x: x + np.array([[0.125], [0.0], [0.0]]) * (3 - 2 * x[0])))


@mistake("joint", "cross", "4 facets", r"around \(1\.125, 1\)", "opposite order")
def mapping_that_turns_the_surface_round(comm):
    paired(comm, Mapped(lambda x: np.array([3.0 - x[0], x[1], x[2]])))


@mistake("joint", "cross", r"1 facets", r"around \(1\.375, 1\)", "opposite order")
def pairs_that_cross(comm):
    paired(comm, Points(PLACES, PLACES[[0, 2, 1, 3, 4]]))


@mistake("joint", "1 slave nodes", "several pairs", r"\(1\.25, 1\)", "once")
def slave_node_in_two_pairs(comm):
    paired(comm, Points(PLACES[[0, 1, 1, 2, 3, 4]], PLACES[[0, 1, 2, 2, 3, 4]]))


@mistake("joint", "1 master nodes", "several slave nodes", r"the first at \(1\.5, 1\); the map")
def master_node_in_two_pairs(comm):
    paired(comm, Points(PLACES, PLACES[[0, 2, 2, 3, 4]]))


@mistake("joint", "1 of 5 slave nodes", r"\(1\.5, 1\)", "partial=True")
def slave_node_in_no_pair(comm):
    paired(comm, Points(PLACES[[0, 1, 3, 4]], PLACES[[0, 1, 3, 4]]))


@mistake("joint", "slave points", "1 pairs", r"\(1\.35, 1\) at distance 0.1 ", "0.025", "toleran")
def slave_points_of_pairs_that_are_no_nodes(comm):
    moved = PLACES + np.outer([0, 1, 0, 0, 0], [0.1, 0, 0])
    paired(comm, Points(moved, PLACES))


@mistake("joint", "master points", "5 pairs", r"\(1, 1\.5\) at distance 0.5 ", "toleran")
def master_points_of_pairs_that_are_no_nodes(comm):
    paired(comm, Points(PLACES, PLACES + [0.0, 0.5, 0.0]))


@mistake("Points", "5 slave points", "4 master points")
def pairs_of_different_lengths(comm):
    paired(comm, Points(PLACES, PLACES[1:]))


@mistake("Points: the slave points", "NaN", "row 2")
def pairs_with_nan(comm):
    paired(comm, Points(np.where(PLACES == 1.5, np.nan, PLACES), PLACES))


@mistake("joint", "normal", "slave", "into the body", "5 nodes", r"\(1, 1\)")
def normal_that_points_inwards(comm):
    paired(comm, normal=(0.0, 1.0))


@mistake("joint", "normal", "along its surface", "1 nodes", r"\(1\.75, 1\)")
def normal_that_is_tangential_somewhere(comm):
    paired(comm, normal=lambda x: np.array([np.isclose(x[0], 1.75), -1.0 + np.isclose(x[0], 1.75)]))


@mistake("joint", "normal", "vanishes", "1 points", r"\(1, 1\)")
def normal_that_vanishes_somewhere(comm):
    paired(comm, normal=lambda x: np.array([0 * x[0], 1.0 - x[0]]))


@mistake("joint", "normal", r"\(3,\)", r"\(2,\)")
def normal_of_a_wrong_shape(comm):
    paired(comm, normal=(0.0, 0.0, 1.0))


@mistake("joint", "normal", "NaN", r"\(1\.5, 1\)")
def normal_that_is_nan_somewhere(comm):
    paired(
        comm, normal=lambda x: np.array([0 * x[0], np.where(np.isclose(x[0], 1.5), np.nan, -1.0)])
    )


@mistake("joint", "4 of 4 slave nodes", "toleran")
def partial_contact_without_any_pair(comm):
    mortar(comm, partners=Mapped(lambda x: x + 5.0), partial=True)


@mistake("contact 0", "1 master nodes", r"\(0.333333, 1\)", "one to one", "Lower the tol")
def partial_contact_that_is_not_one_to_one(comm):
    """The master has 3 elements on the slave's 4."""
    scene = non_matching(comm)
    scene.add_pair(MASTER, SLAVE, partners=Nearest(tolerance=1.0), partial=True)
    scene.problem().solve()


@mistake("one", "two", "1 slave nodes twice", r"\(1\.5, 1\)", "one tag")
def slave_nodes_with_the_same_master_in_two_contacts(comm):
    scene = beams(comm)
    halves = tag_facets(
        scene.mesh,
        [
            (SLAVE, lambda x: np.isclose(x[1], 1.0) & (x[0] > 0.99) & (x[0] < 1.51), 2),
            (MASTER, lambda x: np.isclose(x[1], 1.0) & (x[0] > 0.99) & (x[0] < 2.01), 1),
            (LOADED, lambda x: np.isclose(x[1], 1.0) & (x[0] > 1.49) & (x[0] < 2.01), 2),
        ],
        scene.cell_tags,
    )
    contacts = [
        ContactPair(halves, SLAVE, MASTER, name="one"),
        ContactPair(halves, LOADED, MASTER, name="two"),
    ]
    scene.problem(contacts=contacts).solve()


# -- mortar conditions -------------------------------------------------------------------------


@mistake("joint", "asks for conditions between pairs of nodes", "of degree 2. Leave it out")
def pairs_of_nodes_for_displacements_of_degree_2(comm):
    scene = non_matching(comm)
    joined(scenes.Scene(scene.mesh, scene.facet_tags, degree=2), partners=Nearest())


@mistake("joint", "initial_gap is 'close'", "'touching'")
def unknown_initial_gap(comm):
    mortar(comm, initial_gap="close")


@mistake("joint: initial_gap", "NaN", "4 points")
def initial_gap_that_is_nan(comm):
    mortar(comm, initial_gap=lambda x: np.nan * x[0])


@mistake("joint", "initial_gap='touching'", "geometry=Exact()", "one of them")
def initial_gap_and_exact_passes(comm):
    mortar(comm, initial_gap="touching", geometry=Exact())


def shifted(comm: MPI.Comm, shift: float) -> None:
    """Solve after the upper block has moved along the contact."""
    scene = non_matching(comm)
    scene.mesh.geometry.x[nodes_of(scene.mesh, scene.cell_tags, 2), 0] += shift
    joined(scene)


def nodes_of(mesh, cell_tags, body: int) -> np.ndarray:
    return np.unique(_compat.geometry_cells(mesh)[cell_tags.find(body)])


@mistake("joint", "never meet", "far side")
def surfaces_beside_each_other(comm):
    """The upper block is beside the lower one: along the normals the surfaces never meet."""
    shifted(comm, 3.0)


@mistake("joint", "slivers of 1 slave facets", "too little", "meet at an edge")
def surfaces_that_meet_in_a_sliver(comm):
    shifted(comm, 1.0 - 1e-4)


@mistake("joint", "deeper in the master", "far side")
def surface_inside_the_other_body(comm):
    """A small block within a large one, meshed apart."""
    parts = [((0, 0), (4, 4), (4, 4)), ((1.1, 2), (2.4, 3), (3, 3))]
    marks = [(CLAMPED, at(0, 0.0), 1), (MASTER, at(1, 0.0), 1), (SLAVE, at(1, 3.0), 2)]
    scene = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks)
    scene.fix(CLAMPED)
    joined(scene)


@mistake("joint", "folded by more than 90 degrees", r"\(0\.5, 1\)", "two contacts")
def slave_folded_by_more_than_a_right_angle(comm):
    """Two sides of a wedge of 60 degrees are one slave surface."""
    scene = two_blocks(comm, "triangle", (2, 1))
    x, upper = scene.mesh.geometry.x, nodes_of(scene.mesh, scene.cell_tags, 2)
    low = upper[np.isclose(x[upper, 1], 1.0)]
    x[low, 1] += np.sqrt(3.0) * np.abs(x[low, 0] - 0.5)
    joined(scene)
