"""Results gathered from all ranks, by name, and values at slave nodes of contacts."""

from dataclasses import replace

import numpy as np
import pytest

from fenics_tfeti import ContactPair, ContactResult, InputError, Plane, RigidObstacle
from fenics_tfeti.fem.contact.conditions.contact_conditions import SlaveValues
from fenics_tfeti.fem.contact.descriptions.surfaces import contact_keys, surface_key
from fenics_tfeti.fem.contact.solution.results import ContactEntry, Results


def test_gathered_nodes_are_in_the_order_of_their_numbers():
    nodes = np.array([5, 2, 9])
    column = nodes.astype(float)
    vectors = np.column_stack([column, column])
    entry = ContactEntry("a", 0.0, [], [], [], [], 0.0, {})
    result = ContactResult(
        "a",
        entry,
        nodes,
        nodes,
        vectors,
        column,
        column,
        vectors,
        column,
        column,
        column,
        column > 3.0,
        column,
        column,
    )
    whole = result.gather()
    assert whole.nodes.tolist() == [2, 5, 9]
    assert whole.pressure.tolist() == [2.0, 5.0, 9.0]
    assert whole.active.tolist() == [False, True, True]


def test_results_by_number_and_name():
    entries = [ContactEntry(name, 0.0, [1.0], [], [2.0], [], 0.0, {}) for name in "abb"]
    none, column = np.zeros(0, dtype=np.int64), np.zeros(0)
    found = [
        ContactResult(entry.name, entry, none, none, *[column] * 7, column > 0.0, column, column)
        for entry in entries
    ]
    results = Results(found)
    assert len(results) == 3 and list(results) == found and results.names == ("a", "b", "b")
    assert results["a"] is results[0] is found[0] and results[-1] is found[2]
    assert "a" in results and found[1] in results and "c" not in results
    assert results["a"].force.tolist() == [1.0]
    assert results["a"].seen_from_master().force.tolist() == [2.0]
    with pytest.raises(InputError, match=r"no contact has the name 'c'; the names are \['a', 'b'"):
        results["c"]
    with pytest.raises(InputError, match="more than one contact has the name 'b'"):
        results["b"]
    with pytest.raises(InputError, match="there is no result 3: there are 3, counted from 0"):
        results[3]
    with pytest.raises(TypeError):
        results[0] = found[1]


def test_values_at_slave_nodes_of_contacts():
    forces = SlaveValues({"a": (np.array([3, 5]), np.array([1.0, 2.0]))})
    assert forces.at("a", np.array([5, 4, 3])).tolist() == [2.0, 0.0, 1.0]
    assert forces.at("b", np.array([3, 5])).tolist() == [0.0, 0.0]
    assert SlaveValues(shape=(2,)).at("a", np.array([3])).tolist() == [[0.0, 0.0]]


class Tags:
    """Tags of facets, as far as descriptions look at them."""

    dim = 1

    def __init__(self, cpp_object=None):
        self._cpp_object = cpp_object or self

    def find(self, tag):
        return []


@pytest.fixture
def contacts():
    """Two contacts of different surfaces, two that nothing tells apart, and one with a name."""
    tags, plane = Tags(), Plane((0, 0), (0, 1))
    floors = [RigidObstacle(tags, 7, plane) for _ in range(2)]
    pairs = [ContactPair(tags, 7, 8), ContactPair(tags, 5, 6), ContactPair(tags, 5, 6, name="a")]
    return [*pairs, *floors]


def test_keys_of_contacts(contacts):
    """Objects keep theirs in any order, others take those of the same kind and name or surfaces."""
    keys = contact_keys(contacts)
    assert keys == [
        "ContactPair of the surface 7 and 8",
        "ContactPair of the surface 5 and 6",
        "ContactPair 'a'",
        "RigidObstacle of the surface 7",
        "RigidObstacle of the surface 7 (2)",
    ]
    known = list(zip(contacts, keys, strict=True))
    assert contact_keys(contacts[::-1], known) == keys[::-1]
    assert contact_keys(contacts[4:], known) == keys[4:]
    moved = [replace(contact) for contact in contacts[3::-1]]
    assert contact_keys([*moved, contacts[4]], known) == [*keys[3::-1], keys[4]]
    assert contact_keys([replace(contacts[2], name="b")], known) == ["ContactPair 'b'"]
    # one object twice is two contacts
    assert contact_keys([contacts[3]] * 2, known) == keys[3:]


def test_surfaces_of_one_object_inside_several():
    inside = object()
    assert surface_key(Tags(inside), 3) == surface_key(Tags(inside), 3) != surface_key(Tags(), 3)
