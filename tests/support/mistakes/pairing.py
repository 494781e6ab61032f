"""Mistakes in the pairing of slave and master nodes, and in normals."""

import numpy as np
import scenes
from scenes import CLAMPED, MASTER, ROLLER, SLAVE, at

from fenics_tfeti import Along, Deformed, Mapped, Nearest, Points
from mistakes.catalogue import beams, table

# the slave's nodes of beams()
PLACES = np.array([[1.0, 1.0, 0.0], [1.25, 1, 0], [1.5, 1, 0], [1.75, 1, 0], [2.0, 1, 0]])


def two_blocks(comm, cell="quadrilateral", upper=(3, 4)):
    """Return two unit blocks, one on the other, the lower one of 4 x 4 elements.

    By default two inner slave nodes have no partner.
    """
    marks = [(CLAMPED, at(1, 0.0), 1), (ROLLER, at(1, 2.0), 2)]
    marks += [(MASTER, at(1, 1.0), 1), (SLAVE, at(1, 1.0), 2)]
    parts = [((0, 0), (1, 1), (4, 4)), ((0, 1), (1, 2), upper)]
    scene = scenes.Scene.of_boxes(comm, cell, parts, marks)
    scene.fix(CLAMPED)
    scene.fix(ROLLER)
    return scene


def joined(scene, gaps=None, **of_pair):
    """Solve with the contact between slave and master as described."""
    scene.contacts = []
    scene.add_pair(name="joint", **of_pair)
    scene.problem(gaps=gaps).solve()


def paired(partners=None, **of_pair):
    """Return what solves the beams with other partners, which may be made when it is called."""

    def pose(comm):
        made = partners() if callable(partners) else partners
        joined(beams(comm), partners=made, **of_pair)

    return pose


def points(slaves, masters):
    return paired(lambda: Points(slaves, masters))


def mapped(chi):
    return paired(lambda: Mapped(chi))


def normal(value):
    return paired(normal=value)


def mortar(gaps=None, **of_pair):
    """Return what solves the blocks whose meshes do not match."""
    return lambda comm: joined(two_blocks(comm), gaps, **of_pair)


def direction_that_misses(comm):
    joined(scenes.two_beams(comm, "quadrilateral", 4, gap=0.1), partners=Along((1.0, -1.0)))


def partial_contact_that_is_not_one_to_one(comm):
    """The master has 3 elements on the slave's 4."""
    scene = two_blocks(comm)
    scene.add_pair(MASTER, SLAVE, partners=Nearest(tolerance=1.0), partial=True)
    scene.problem().solve()


def pairs_of_degree_2(comm):
    scene = two_blocks(comm)
    joined(scenes.Scene(scene.mesh, scene.facet_tags, degree=2), partners=Nearest())


def shifted(shift):
    """Return what solves after the upper block has moved along the contact."""

    def pose(comm):
        scene = two_blocks(comm)
        scene.mesh.geometry.x[scene.nodes(2), 0] += shift
        joined(scene)

    return pose


def surface_inside_the_other_body(comm):
    """A small block within a large one, meshed apart."""
    parts = [((0, 0), (4, 4), (4, 4)), ((1.1, 2), (2.4, 3), (3, 3))]
    marks = [(CLAMPED, at(0, 0.0), 1), (MASTER, at(1, 0.0), 1), (SLAVE, at(1, 3.0), 2)]
    scene = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks)
    scene.fix(CLAMPED)
    joined(scene)


def inward_but_at(place):
    """Return a normal that is tangential where x is `place`."""
    return lambda x: np.array([np.isclose(x[0], place), -1.0 + np.isclose(x[0], place)])


def not_one_to_one(*masters):
    return points(PLACES, PLACES[list(masters)])


MISTAKES = table(
    "Partners, gaps and normals",
    ("slave nodes without partner", mortar(partners=Nearest())),
    ("unknown partners", paired("nts")),
    ("tolerance that is negative", paired(lambda: Nearest(tolerance=-0.1))),
    ("direction of a wrong shape", paired(lambda: Along((0.0, 0.0, 1.0)))),
    ("direction of no length", paired(lambda: Along((0.0, 0.0)))),
    (
        "direction that vanishes somewhere",
        paired(lambda: Along(lambda x: x[:2] - np.array([[1.5], [1.0]]))),
    ),
    ("direction that misses", direction_that_misses),
    ("mapping that is no function", mapped((0.0, 1.0))),
    ("mapping of a wrong shape", mapped(lambda x: x[0])),
    (
        "mapping that is NaN somewhere",
        mapped(lambda x: np.where(np.isclose(x[0], 1.25), np.nan, x)),
    ),
    ("mapping that fails", mapped(lambda x: {}["chi"])),
    (
        "mapping that misses the nodes",
        mapped(lambda x: x + np.array([[0.125], [0.0], [0.0]]) * (3 - 2 * x[0])),
    ),
    ("mapping that turns the surface round", mapped(lambda x: np.array([3.0 - x[0], x[1], x[2]]))),
    ("pairs that cross", not_one_to_one(0, 2, 1, 3, 4)),
    ("slave node in two pairs", points(PLACES[[0, 1, 1, 2, 3, 4]], PLACES[[0, 1, 2, 2, 3, 4]])),
    ("master node in two pairs", not_one_to_one(0, 2, 2, 3, 4)),
    ("slave node in no pair", points(PLACES[[0, 1, 3, 4]], PLACES[[0, 1, 3, 4]])),
    (
        "slave points of pairs that are no nodes",
        points(PLACES + np.outer([0, 1, 0, 0, 0], [0.1, 0, 0]), PLACES),
    ),
    ("master points of pairs that are no nodes", points(PLACES, PLACES + [0.0, 0.5, 0.0])),
    ("pairs of different lengths", points(PLACES, PLACES[1:])),
    ("pairs with NaN", points(np.where(PLACES == 1.5, np.nan, PLACES), PLACES)),
    ("normal that points inwards", normal((0.0, 1.0))),
    ("normal that is tangential somewhere", normal(inward_but_at(1.75))),
    ("normal that vanishes somewhere", normal(lambda x: np.array([0 * x[0], 1.0 - x[0]]))),
    ("normal of a wrong shape", normal((0.0, 0.0, 1.0))),
    (
        "normal that is NaN somewhere",
        normal(lambda x: np.array([0 * x[0], np.where(np.isclose(x[0], 1.5), np.nan, -1.0)])),
    ),
    ("partial contact without any pair", mortar(partners=Mapped(lambda x: x + 5.0), partial=True)),
    ("partial contact that is not one to one", partial_contact_that_is_not_one_to_one),
    ("pairs of nodes for displacements of degree 2", pairs_of_degree_2),
    ("unknown initial gap", mortar(initial_gap="close")),
    ("initial gap that is NaN", mortar(initial_gap=lambda x: np.nan * x[0])),
    ("initial gap and exact passes", mortar(initial_gap="touching", gaps=Deformed())),
    ("surfaces beside each other", shifted(3.0)),
    ("surfaces that meet in a sliver", shifted(1.0 - 1e-4)),
    ("surface inside the other body", surface_inside_the_other_body),
)
