"""The tree finds all facets whose boxes a query wants."""

import numpy as np
import pytest

from fenics_tfeti.fem.geometry.box_tree import BoxTree


def segments(number):
    """Return segments from k to k + 1/2 on a line."""
    start = np.column_stack([np.arange(number), np.zeros(number)]).astype(float)
    return np.stack([start, start + [0.5, 0.0]], axis=1)


def containing(x):
    def wanted(query, low, high):
        return np.all((low <= x[query]) & (x[query] <= high), axis=1)

    return wanted


@pytest.mark.parametrize("number", [1, 2, 3, 7, 64, 1000])
def test_the_facet_around_each_point_is_found_and_no_other(number):
    tree = BoxTree(segments(number))
    x = np.column_stack([np.arange(number) + 0.25, np.zeros(number)])
    query, facet = tree.candidates(number, containing(x))
    np.testing.assert_array_equal(query, np.arange(number))
    np.testing.assert_array_equal(facet, np.arange(number))


def test_size_is_that_of_the_box_around_all():
    assert BoxTree(segments(10)).size == 9.5


def test_no_queries():
    query, facet = BoxTree(segments(3)).candidates(0, containing(np.zeros((0, 2))))
    assert query.size == facet.size == 0
