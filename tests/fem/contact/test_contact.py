"""Results gathered from all ranks, by name, and values at slave nodes of contacts."""

import numpy as np
import pytest

from fenics_tfeti import ContactResult, InputError
from fenics_tfeti.fem.contact.conditions.pairing import SlaveValues
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
    forces = SlaveValues.of([(np.array([3, 5]), np.array([1.0, 2.0])), (np.array([3]), np.ones(1))])
    assert forces.at(0, np.array([5, 4, 3])).tolist() == [2.0, 0.0, 1.0]
    assert forces.at(1, np.array([3, 5])).tolist() == [1.0, 0.0]
    assert forces.of_first(1).at(1, np.array([3])).tolist() == [0.0]
    assert SlaveValues.of([], 2).at(0, np.array([3])).tolist() == [[0.0, 0.0]]
