"""Results gathered from all ranks."""

from __future__ import annotations

import numpy as np

from fenics_tfeti import ContactResult


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
