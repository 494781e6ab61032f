"""Nodes and their copies."""

import numpy as np
import pytest

from fenics_tfeti.feti.constraints.nodes import count_copies

pytestmark = pytest.mark.once


@pytest.mark.parametrize("nodes", [
    [], [7], [4, 2, 4, 5, 2, 4], [-3, 10**17, -3, 5], [2**61, 2**61 - 1, 2**61],
], ids=["none", "one", "close together", "far apart", "large"])  # fmt: skip
def test_copies_are_counted_as_by_sorting(nodes):
    nodes = np.array(nodes, dtype=np.int64)
    expected = np.unique(nodes, return_inverse=True, return_counts=True)
    for found, values in zip(count_copies(nodes), expected, strict=True):
        np.testing.assert_array_equal(found, values)
        assert found.dtype == np.int64
