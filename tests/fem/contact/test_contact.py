"""Names of contacts, and results gathered from all ranks."""

from __future__ import annotations

import numpy as np

from fenics_tfeti import ContactPair, ContactResult, Plane, RigidObstacle
from fenics_tfeti.fem.contact.contact import contact_name

FLOOR = Plane((0.0, 0.0), (0.0, 1.0))


def test_default_name_of_a_pair():
    assert contact_name(ContactPair(None, 1, 2), 3) == "contact 3 (pair)"


def test_default_name_of_an_obstacle():
    assert contact_name(RigidObstacle(None, 1, FLOOR), 0) == "contact 0 (obstacle)"


def test_given_name():
    assert contact_name(RigidObstacle(None, 1, FLOOR, name="floor"), 0) == "floor"


def test_gathered_nodes_are_in_the_order_of_their_numbers():
    nodes = np.array([5, 2, 9])
    column = nodes.astype(float)
    vectors = np.column_stack([column, column])
    result = ContactResult(
        "a", nodes, vectors, column, column, vectors, column, column, column > 3.0, column, column
    )
    whole = result.gather()
    assert whole.nodes.tolist() == [2, 5, 9]
    assert whole.pressure.tolist() == [2.0, 5.0, 9.0]
    assert whole.active.tolist() == [False, True, True]
