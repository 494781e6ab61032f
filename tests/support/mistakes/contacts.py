"""Mistakes in what may touch what: tags, roles of surfaces, obstacles."""

import numpy as np
import scenes
from scenes import CLAMPED, MASTER, SLAVE, at

import ufl
from dolfinx import fem

from fenics_tfeti import (
    Cohesive,
    ContactPair,
    Coulomb,
    Deformed,
    Plane,
    RigidObstacle,
    SelfContact,
    SoftContact,
    Sphere,
)
from mistakes.catalogue import beams, other_beams, posed, solved, table


def paired(slave, master, tags=lambda scene: scene.facet_tags):
    """Return what solves the beams with a contact between other surfaces, or of other tags."""
    return solved(contacts=lambda s: [ContactPair(tags(s), slave=slave, master=master)])


def above(obstacle, slave=SLAVE, **more):
    """Return what solves the beams on an obstacle in place of each other."""
    return solved(contacts=lambda s: [RigidObstacle(s.facet_tags, slave, obstacle)], **more)


def of_points(values):
    """Return an obstacle whose gaps are x[1], with normals (2, k)."""
    return lambda x: (x[1], np.tile(np.array(values)[:, None], x.shape[1]))


def weighted(weight):
    """Return what poses the beams, whose nodes have x >= 0, with a weight of the measure."""
    return posed(
        contacts=lambda s: [ContactPair(s.facet_tags, SLAVE, MASTER, name="joint")],
        measure_weight=weight,
    )


def with_law(scene, law):
    return ContactPair(scene.facet_tags, SLAVE, MASTER, name="joint", law=law)


def soft_and_exact(comm):
    """Pose the beams with a law that is for undeformed surfaces."""
    posed(contacts=lambda s: [with_law(s, SoftContact(1e9))], gaps=Deformed())(comm)


def radius(scene):
    return ufl.SpatialCoordinate(scene.mesh)[0]


def plates(slave, master, **more):
    """Return what lays a plate on another, 4 m wide and 0.5 m thick, and pairs two faces."""

    def pose(comm):
        marks = [(tag, at(1, height), body) for tag, (body, height) in ((41, slave), (42, master))]
        parts = [((0, 0), (4, 0.5), (8, 2)), ((0, 0.5), (4, 1.0), (8, 2))]
        marks.append((CLAMPED, at(0, 0.0)))
        scene = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks)
        scene.L = scene.constant(-1.0) * scene.v[1] * ufl.dx
        scene.fix(CLAMPED)
        scene.add_pair(41, 42)
        scene.problem(**more).solve()

    return pose


def wrong_before_a_later_step(comm):
    problem = beams(comm).problem()
    problem.contacts.append("floor")
    problem.solve()


FLOOR = scenes.plane(1, 2)

MISTAKES = table(
    "Contact pairs and obstacles",
    ("slave tag on no facet", paired(99, MASTER)),
    ("master tag on no facet", paired(SLAVE, 98)),
    ("obstacle tag on no facet", above(FLOOR, slave=97)),
    ("slave is its own master", paired(SLAVE, SLAVE)),
    (
        "slave of one contact is master of another",
        solved(contacts=lambda s: [*s.contacts, ContactPair(s.facet_tags, MASTER, SLAVE)]),
    ),
    ("cell tags for facet tags", paired(1, 2, lambda s: s.cell_tags)),
    (
        "facet tags of another mesh",
        paired(SLAVE, MASTER, lambda s: other_beams(s.mesh.comm).facet_tags),
    ),
    ("obstacle returns NaN", above(lambda x: (np.nan * x[1], of_points((0.0, 1.0))(x)[1]))),
    ("obstacle returns minus infinity", above(lambda x: np.full(x.shape[1], -np.inf))),
    ("obstacle returns a gap but NaN for the normal", above(of_points((np.nan, np.nan)))),
    ("obstacle returns a wrong shape", above(lambda x: (0.0, np.array([0.0, 1.0])))),
    ("obstacle returns normals of no unit length", above(of_points((0.0, 2.0)))),
    ("obstacle that fails", above(lambda x: 1 / 0)),
    ("obstacle returns nothing", above(lambda x: "far away")),
    ("slave node at the centre of the sphere", above(Sphere((1.5, 1.0), 0.1))),
    ("obstacle on the wrong side", above(Plane((0.0, 1.0), (0.0, -1.0)))),
    ("surfaces that look the same way", plates((1, 0.5), (2, 1.0))),
    (
        "surfaces that look the same way after a solve with exact non-penetration",
        plates((1, 0.5), (2, 1.0), gaps=Deformed()),
    ),
    ("surfaces that lie back to back", plates((2, 1.0), (1, 0.0))),
    ("tag that is a name", paired("top", MASTER)),
    ("several tags, one of them no integer", paired(SLAVE, [MASTER, 6.5])),
    ("facet tags that are an array", paired(SLAVE, MASTER, lambda s: np.zeros(3))),
    ("contact of a wrong type", posed(contacts=[(SLAVE, MASTER)])),
    ("contacts that are a number", posed(contacts=SLAVE)),
    ("wrong contact before a later step", wrong_before_a_later_step),
    ("obstacle that is no function", above(0.0)),
    (
        "friction that is an expression",
        posed(contacts=lambda s: [ContactPair(s.facet_tags, 1, 2, friction=Coulomb(radius(s)))]),
    ),
    (
        "surface that touches itself without its tags",
        posed(contacts=lambda s: [SelfContact(surface=SLAVE, name="fold")]),
    ),
    (
        "search distance in another unit",
        posed(contacts=lambda s: [SelfContact(s.facet_tags, SLAVE, distance=500.0)]),
    ),
    (
        "friction that varies over a surface that touches itself",
        posed(contacts=lambda s: [SelfContact(friction=Coulomb(lambda x: 0.1 * x[0]))]),
    ),
    (
        "soft contact of no stiffness somewhere",
        posed(contacts=lambda s: [with_law(s, SoftContact(lambda x: x[0] - 1.0))]),
    ),
    (
        "bond that stores more than its failure takes",
        posed(contacts=lambda s: [with_law(s, Cohesive(1e6, 100.0, stiffness=1e9))]),
    ),
    (
        "bond without energy somewhere",
        posed(contacts=lambda s: [with_law(s, Cohesive(1e6, lambda x: x[0] - 1.0))]),
    ),
    ("soft contact that sticks to the deformed surfaces", soft_and_exact),
    ("weight that is negative", weighted(lambda s: -2 * ufl.pi * radius(s))),
    ("weight that is negative somewhere", weighted(lambda s: radius(s) - 1.4)),
    ("weight that is zero", weighted(0.0)),
    ("weight that is NaN", weighted(lambda s: fem.Constant(s.mesh, np.nan))),
    ("weight that is a vector", weighted(lambda s: ufl.SpatialCoordinate(s.mesh))),
    ("weight on another mesh", weighted(lambda s: radius(s) * radius(other_beams(s.mesh.comm)))),
    ("weight with a test function", weighted(lambda s: ufl.TestFunction(s.V)[0])),
    ("weight that is a text", weighted("2 pi r")),
    ("weight of an obstacle that is negative", above(FLOOR, measure_weight=lambda s: -radius(s))),
)
