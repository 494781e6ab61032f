"""Descriptions of contacts check themselves: the error is where they are made."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import MASTER, SLAVE

import ufl

from fenics_tfeti import (
    Along,
    ContactPair,
    Coulomb,
    InputError,
    Mapped,
    Nearest,
    Plane,
    Points,
    RigidObstacle,
    SelfContact,
    TiedPair,
    Tresca,
)
from fenics_tfeti.fem.contact.descriptions.surfaces import contact_name, surface_tags
from fenics_tfeti.fem.topology import with_tag_names

FLOOR = Plane((0.0, 0.0), (0.0, 1.0))
BEAMS = scenes.two_beams(MPI.COMM_SELF, "triangle", 2)
TAGS = BEAMS.facet_tags
PAIR = ContactPair(TAGS, SLAVE, MASTER, name="joint")
OBSTACLE = RigidObstacle(TAGS, SLAVE, FLOOR)
TIE = TiedPair(TAGS, SLAVE, MASTER)


def test_names():
    assert contact_name(ContactPair(TAGS, 1, 2), 3) == "contact 3 (pair)"
    assert contact_name(OBSTACLE, 0) == "contact 0 (obstacle)"
    assert contact_name(replace(OBSTACLE, name="floor"), 0) == "floor"
    assert contact_name(TIE, 1) == "tied pair 1"


@pytest.mark.parametrize(
    ("contact", "change", "message"),
    [
        (PAIR, {"name": 7}, "ContactPair: name is 7"),
        (PAIR, {"partners": Nearest}, "joint: partners is <class"),
        (PAIR, {"partners": np.ones(2)}, "joint: partners is array"),
        (PAIR, {"partial": "yes"}, "joint: partial is 'yes'"),
        (PAIR, {"roles": "any"}, "joint: roles is 'any'"),
        (PAIR, {"friction": 0.3}, "joint: friction is a float; Tresca"),
        (PAIR, {"friction": Tresca}, "joint: friction is a type"),
        *[
            (PAIR, {"initial_gap": gap}, "joint: initial_gap is .* 'touching'")
            for gap in ("closed", None, True, np.nan, [0.1])
        ],
        (PAIR, {"normal": (0.0, 0.0)}, "joint: the normal is .* no direction"),
        (PAIR, {"normal": 1.0}, "joint: the normal is 1.0: two or three finite numbers"),
        (OBSTACLE, {"slave": True}, "RigidObstacle: the tag of the slave is True"),
        (OBSTACLE, {"displacement": (1.0, 0.0)}, "RigidObstacle: .* has no effect without fric"),
        (TIE, {"master": SLAVE}, "TiedPair: slave and master have the same tag .*tied already"),
        (TIE, {"master": "upper"}, "TiedPair: the tag of the master"),
        (TIE, {"facet_tags": None}, "TiedPair: facet_tags is a NoneType"),
    ],
)
def test_mistakes(contact, change, message):
    with pytest.raises(InputError, match=message):
        replace(contact, **change)


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan, "1 MPa", True, np.ones(9), None])
def test_what_is_no_bound_and_no_coefficient(value):
    with pytest.raises(InputError, match="slip_bound is .*; a finite number, at least 0"):
        Tresca(value)
    with pytest.raises(InputError, match="coefficient is .*; a finite number, at least 0"):
        Coulomb(value)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (Along, ("down",), "the direction is 'down': two or three finite numbers"),
        (Along, ((0.0, 1.0), 0.0), "the tolerance is 0.0; a positive number"),
        (Mapped, ((0, 1),), r"the mapping is \(0, 1\); a function"),
        (Points, ([[0.0, np.nan]], [[0.0, 1.0]]), "the slave points are NaN .* row 0"),
        (Points, ([[0.0, 1.0]], [0.0, 1.0]), r"the master points have shape \(2,\)"),
        (Points, (np.zeros((1, 2)), np.zeros((2, 2))), "1 slave points and 2 master points"),
    ],
)
def test_what_are_no_partners(kind, arguments, message):
    with pytest.raises(InputError, match=f"{kind.__name__}: {message}"):
        kind(*arguments)


EXPRESSION = 0.2 + 0.1 * ufl.SpatialCoordinate(BEAMS.mesh)[0]


@pytest.mark.parametrize(
    ("describe", "what"),
    [
        (Coulomb, "Coulomb: the coefficient"),
        (Tresca, "Tresca: the slip_bound"),
        (Along, "Along: the direction"),
        (Mapped, "Mapped: the mapping"),
        (lambda x: replace(PAIR, initial_gap=x), "joint: initial_gap"),
        (lambda x: replace(PAIR, normal=x), "joint: the normal"),
        (lambda x: replace(OBSTACLE, obstacle=x), "RigidObstacle: the obstacle"),
        (lambda x: replace(OBSTACLE, friction=Coulomb(1.0), displacement=x), ".*'s displacement"),
    ],
)
def test_expressions_of_ufl_are_no_functions_of_points(describe, what):
    """They can be called, too."""
    assert callable(EXPRESSION)
    with pytest.raises(
        InputError, match=f"^{what} is a UFL expression, .* such as lambda x"
    ) as told:
        describe(EXPRESSION)
    assert ("f.interpolate(Expression(" in str(told.value)) == (describe in (Coulomb, Tresca))


def named_tags():
    """Return facet tags with names."""
    tags = scenes.two_beams(MPI.COMM_SELF, "triangle", 2).facet_tags
    return with_tag_names(tags, {SLAVE: "foot of stamp", MASTER: "base"})


@pytest.mark.parametrize(
    ("describe", "tags"),
    [
        (lambda tags: ContactPair(tags, "foot of stamp", "base"), [SLAVE, MASTER]),
        (lambda tags: ContactPair(tags, SLAVE, "base"), [SLAVE, MASTER]),
        (lambda tags: TiedPair(tags, "base", "foot of stamp"), [MASTER, SLAVE]),
        (lambda tags: RigidObstacle(tags, "base", Plane((0, 0), (0, 1))), [MASTER]),
        (lambda tags: SelfContact(tags, "base"), [MASTER]),
    ],
)
def test_names_of_surfaces_become_their_tags(describe, tags):
    assert surface_tags(describe(named_tags())) == tags


def test_name_that_no_surface_has():
    message = "the tag of the slave is 'foot'; .* The names are 'base', 'foot of stamp'$"
    with pytest.raises(InputError, match=message):
        ContactPair(named_tags(), "foot", MASTER)
