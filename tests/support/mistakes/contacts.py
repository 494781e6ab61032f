"""Mistakes in what may touch what: tags, roles of surfaces, obstacles."""

from __future__ import annotations

import numpy as np
import scenes
from scenes import MASTER, SLAVE

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Plane, RigidObstacle, Sphere
from mistakes.catalogue import beams, mistake


def paired(comm, slave, master, tags=None):
    """Solve for the beams with a contact between other surfaces, or of other facet tags."""
    scene = beams(comm)
    pair = ContactPair(scene.facet_tags if tags is None else tags, slave=slave, master=master)
    scene.problem(contacts=[pair]).solve()


def above(comm, obstacle, slave=SLAVE, **arguments):
    """Solve for the beams on an obstacle in place of each other."""
    scene = beams(comm)
    contact = RigidObstacle(scene.facet_tags, slave, obstacle)
    scene.problem(contacts=[contact], **arguments).solve()


@mistake("99", "facet")
def slave_tag_on_no_facet(comm):
    paired(comm, 99, MASTER)


@mistake("98", "facet")
def master_tag_on_no_facet(comm):
    paired(comm, SLAVE, 98)


@mistake("97", "facet")
def obstacle_tag_on_no_facet(comm):
    above(comm, scenes.plane(1, 2), slave=97)


@mistake("slave", "master", r"\b5\b")
def slave_is_its_own_master(comm):
    paired(comm, SLAVE, SLAVE)


@mistake("slave", "master", "contacts 0 and 1")
def slave_of_one_contact_is_master_of_another(comm):
    scene = beams(comm)
    scene.add_pair(MASTER, SLAVE)
    scene.problem().solve()


@mistake("contact 0", "facet_tags", "dimension 2")
def cell_tags_for_facet_tags(comm):
    scene = beams(comm)
    scene.problem(contacts=[ContactPair(scene.cell_tags, slave=1, master=2)]).solve()


@mistake("contact 0", "facet_tags", "another mesh")
def facet_tags_of_another_mesh(comm):
    paired(comm, SLAVE, MASTER, beams(comm).facet_tags)


@mistake("obstacle", "NaN")
def obstacle_returns_nan(comm):
    above(comm, lambda x: (np.full(x.shape[1], np.nan), np.tile([[0.0], [1.0]], x.shape[1])))


@mistake("contact 0", "gap", r"\+inf", "where there is no obstacle")
def obstacle_returns_minus_infinity(comm):
    above(comm, lambda x: np.full(x.shape[1], -np.inf))


@mistake("contact 0", "normal is NaN", "5 points")
def obstacle_returns_a_gap_but_nan_for_the_normal(comm):
    above(comm, lambda x: (x[1], np.full((2, x.shape[1]), np.nan)))


@mistake("obstacle", "shape", r"\(5,\) and \(2, 5\)")
def obstacle_returns_a_wrong_shape(comm):
    above(comm, lambda x: (0.0, np.array([0.0, 1.0])))


@mistake("contact 0", "normal", "unit")
def obstacle_returns_normals_of_no_unit_length(comm):
    above(comm, lambda x: (x[1], np.tile([[0.0], [2.0]], x.shape[1])))


@mistake("obstacle", "(?i)ZeroDivisionError", "shape")
def obstacle_that_fails(comm):
    above(comm, lambda x: 1 / 0)


@mistake("obstacle", r"\(gap, normal\)")
def obstacle_returns_nothing(comm):
    above(comm, lambda x: "far away")


@mistake("centre", r"\(1\.5, 1\)", "contact 0")
def slave_node_at_the_centre_of_the_sphere(comm):
    above(comm, Sphere((1.5, 1.0), 0.1))


@mistake("contact 0", "obstacle", "hollow=True", "change its sign", r"\b5\b")
def obstacle_on_the_wrong_side(comm):
    above(comm, Plane((0.0, 1.0), (0.0, -1.0)))


LOWER_FACE, UPPER_FACE = 41, 42


def plates(comm, slave, master):
    """Lay a plate on another, 4 m wide and 0.5 m thick each, and pair two of their faces."""
    (slave_body, slave_side), (master_body, master_side) = slave, master
    marks = [
        (LOWER_FACE, scenes.at(1, slave_side), slave_body),
        (UPPER_FACE, scenes.at(1, master_side), master_body),
        (scenes.CLAMPED, scenes.at(0, 0.0)),
    ]
    parts = [((0, 0), (4, 0.5), (8, 2)), ((0, 0.5), (4, 1.0), (8, 2))]
    scene = scenes.Scene.of_boxes(comm, "quadrilateral", parts, marks)
    scene.L = scene.constant(-1.0) * scene.v[1] * ufl.dx
    scene.fix(scenes.CLAMPED)
    scene.add_pair(LOWER_FACE, UPPER_FACE)
    scene.problem().solve()


@mistake("contact 0", "same way", "9 nodes", "far side")
def surfaces_that_look_the_same_way(comm):
    plates(comm, (1, 0.5), (2, 1.0))


@mistake("contact 0", "9 slave nodes", "thick", "up to 1,", "far side")
def surfaces_that_lie_back_to_back(comm):
    plates(comm, (2, 1.0), (1, 0.0))


@mistake("ContactPair: the tag of the slave", "'top'", "integer")
def tag_that_is_a_name(comm):
    paired(comm, "top", MASTER)


@mistake("ContactPair: the tag of the master", r"\[6\]", "integer", "join them")
def several_tags(comm):
    paired(comm, SLAVE, [MASTER])


@mistake("ContactPair: facet_tags", "ndarray", "meshtags")
def facet_tags_that_are_an_array(comm):
    paired(comm, SLAVE, MASTER, np.zeros(3))


@mistake("contact 0", "tuple", "ContactPair, RigidObstacle, TiedPair")
def contact_of_a_wrong_type(comm):
    beams(comm).problem(contacts=[(SLAVE, MASTER)])


@mistake("contacts is a int", "list of ContactPair")
def contacts_that_are_a_number(comm):
    beams(comm).problem(contacts=SLAVE)


@mistake("contact 1", "str", "ContactPair")
def wrong_contact_before_a_later_step(comm):
    problem = beams(comm).problem()
    problem.contacts.append("floor")
    problem.solve()


@mistake("RigidObstacle: the obstacle is a float", "Plane")
def obstacle_that_is_no_function(comm):
    above(comm, 0.0)


def weighted(comm, weight):
    """Pose the beams, whose nodes have x >= 0, with a weight of the surface measure."""
    scene = beams(comm)
    given = weight(scene) if callable(weight) else weight
    pair = ContactPair(scene.facet_tags, SLAVE, MASTER, name="joint")
    scene.problem(contacts=[pair], measure_weight=given)


def radius(scene):
    return ufl.SpatialCoordinate(scene.mesh)[0]


@mistake("slave of joint", "measure_weight", "negative or zero", "5 nodes", r"\(1, 1\)", "radius")
def weight_that_is_negative(comm):
    weighted(comm, lambda scene: -2 * ufl.pi * radius(scene))


@mistake("slave of joint", "measure_weight", "negative or zero", "2 nodes", r"\(1, 1\)")
def weight_that_is_negative_somewhere(comm):
    weighted(comm, lambda scene: radius(scene) - 1.4)


@mistake("slave of joint", "measure_weight", "negative or zero", "5 nodes")
def weight_that_is_zero(comm):
    weighted(comm, 0.0)


@mistake("slave of joint", "measure_weight", "NaN or infinite", "5 nodes", r"\(1, 1\)")
def weight_that_is_nan(comm):
    weighted(comm, lambda scene: fem.Constant(scene.mesh, np.nan))


@mistake("measure_weight", r"shape \(2,\)", "scalar")
def weight_that_is_a_vector(comm):
    weighted(comm, lambda scene: ufl.SpatialCoordinate(scene.mesh))


@mistake("measure_weight", "another mesh")
def weight_on_another_mesh(comm):
    other = beams(comm)
    weighted(comm, lambda scene: radius(scene) * radius(other))


@mistake("measure_weight", "test or trial function")
def weight_with_a_test_function(comm):
    weighted(comm, lambda scene: ufl.TestFunction(scene.V)[0])


@mistake("measure_weight is a str", "expression of UFL")
def weight_that_is_a_text(comm):
    weighted(comm, "2 pi r")


@mistake("contact 0", "measure_weight", "negative or zero", "slave", "axis")
def weight_of_an_obstacle_that_is_negative(comm):
    scene = beams(comm)
    obstacle = RigidObstacle(scene.facet_tags, SLAVE, scenes.plane(1, 2))
    scene.problem(contacts=[obstacle], measure_weight=-radius(scene))
