"""Mistakes in what may touch what: tags, roles of surfaces, obstacles."""

from __future__ import annotations

import numpy as np
import scenes
from scenes import CLAMPED, MASTER, SLAVE, at

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Plane, RigidObstacle, Sphere
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


def radius(scene):
    return ufl.SpatialCoordinate(scene.mesh)[0]


def plates(slave, master):
    """Return what lays a plate on another, 4 m wide and 0.5 m thick, and pairs two faces."""

    def pose(comm):
        marks = [(tag, at(1, height), body) for tag, (body, height) in ((41, slave), (42, master))]
        parts = [((0, 0), (4, 0.5), (8, 2)), ((0, 0.5), (4, 1.0), (8, 2))]
        marks.append((CLAMPED, at(0, 0.0)))
        scene = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks)
        scene.L = scene.constant(-1.0) * scene.v[1] * ufl.dx
        scene.fix(CLAMPED)
        scene.add_pair(41, 42)
        scene.problem().solve()

    return pose


def wrong_before_a_later_step(comm):
    problem = beams(comm).problem()
    problem.contacts.append("floor")
    problem.solve()


FLOOR = scenes.plane(1, 2)
NEGATIVE = "slave of joint", "measure_weight", "negative or zero"

MISTAKES = table(
    "Contact pairs and obstacles",
    ("slave tag on no facet", paired(99, MASTER), "99", "facet"),
    ("master tag on no facet", paired(SLAVE, 98), "98", "facet"),
    ("obstacle tag on no facet", above(FLOOR, slave=97), "97", "facet"),
    ("slave is its own master", paired(SLAVE, SLAVE), "slave", "master", r"\b5\b"),
    ("slave of one contact is master of another",
     solved(contacts=lambda s: [*s.contacts, ContactPair(s.facet_tags, MASTER, SLAVE)]),
     "slave", "master", "contacts 0 and 1"),
    ("cell tags for facet tags", paired(1, 2, lambda s: s.cell_tags),
     "contact 0", "facet_tags", "dimension 2"),
    ("facet tags of another mesh",
     paired(SLAVE, MASTER, lambda s: other_beams(s.mesh.comm).facet_tags),
     "contact 0", "facet_tags", "another mesh"),
    ("obstacle returns NaN",
     above(lambda x: (np.nan * x[1], of_points((0.0, 1.0))(x)[1])), "obstacle", "NaN"),
    ("obstacle returns minus infinity", above(lambda x: np.full(x.shape[1], -np.inf)),
     "contact 0", "gap", r"\+inf", "where there is no obstacle"),
    ("obstacle returns a gap but NaN for the normal", above(of_points((np.nan, np.nan))),
     "contact 0", "normal is NaN", "5 points"),
    ("obstacle returns a wrong shape", above(lambda x: (0.0, np.array([0.0, 1.0]))),
     "obstacle", "shape", r"\(5,\) and \(2, 5\)"),
    ("obstacle returns normals of no unit length", above(of_points((0.0, 2.0))),
     "contact 0", "normal", "unit"),
    ("obstacle that fails", above(lambda x: 1 / 0), "obstacle", "(?i)ZeroDivisionError", "shape"),
    ("obstacle returns nothing", above(lambda x: "far away"), "obstacle", r"\(gap, normal\)"),
    ("slave node at the centre of the sphere", above(Sphere((1.5, 1.0), 0.1)),
     "centre", r"\(1\.5, 1\)", "contact 0"),
    ("obstacle on the wrong side", above(Plane((0.0, 1.0), (0.0, -1.0))),
     "contact 0", "obstacle", "hollow=True", "change its sign", r"\b5\b"),
    ("surfaces that look the same way", plates((1, 0.5), (2, 1.0)),
     "contact 0", "same way", "9 nodes", "far side"),
    ("surfaces that lie back to back", plates((2, 1.0), (1, 0.0)),
     "contact 0", "9 slave nodes", "thick", "up to 1,", "far side"),
    ("tag that is a name", paired("top", MASTER),
     "ContactPair: the tag of the slave", "'top'", "integer"),
    ("several tags", paired(SLAVE, [MASTER]),
     "ContactPair: the tag of the master", r"\[6\]", "integer", "join them"),
    ("facet tags that are an array", paired(SLAVE, MASTER, lambda s: np.zeros(3)),
     "ContactPair: facet_tags", "ndarray", "meshtags"),
    ("contact of a wrong type", posed(contacts=[(SLAVE, MASTER)]),
     "contact 0", "tuple", "ContactPair, RigidObstacle, TiedPair"),
    ("contacts that are a number", posed(contacts=SLAVE),
     "contacts is a int", "list of ContactPair"),
    ("wrong contact before a later step", wrong_before_a_later_step,
     "contact 1", "str", "ContactPair"),
    ("obstacle that is no function", above(0.0),
     "RigidObstacle: the obstacle is a float", "Plane"),
    ("weight that is negative", weighted(lambda s: -2 * ufl.pi * radius(s)),
     *NEGATIVE, "5 nodes", r"\(1, 1\)", "radius"),
    ("weight that is negative somewhere", weighted(lambda s: radius(s) - 1.4),
     *NEGATIVE, "2 nodes", r"\(1, 1\)"),
    ("weight that is zero", weighted(0.0), *NEGATIVE, "5 nodes"),
    ("weight that is NaN", weighted(lambda s: fem.Constant(s.mesh, np.nan)),
     "slave of joint", "measure_weight", "NaN or infinite", "5 nodes", r"\(1, 1\)"),
    ("weight that is a vector", weighted(lambda s: ufl.SpatialCoordinate(s.mesh)),
     "measure_weight", r"shape \(2,\)", "scalar"),
    ("weight on another mesh", weighted(lambda s: radius(s) * radius(other_beams(s.mesh.comm))),
     "measure_weight", "another mesh"),
    ("weight with a test function", weighted(lambda s: ufl.TestFunction(s.V)[0]),
     "measure_weight", "test or trial function"),
    ("weight that is a text", weighted("2 pi r"), "measure_weight is a str", "expression of UFL"),
    ("weight of an obstacle that is negative", above(FLOOR, measure_weight=lambda s: -radius(s)),
     "contact 0", "measure_weight", "negative or zero", "slave", "axis"),
)  # fmt: skip
