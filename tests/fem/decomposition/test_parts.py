"""Congruent parts have equal tables, and only equal parts share."""

import numpy as np
import pytest
from box_rows import NUMBER, row_of_boxes
from scenes import CELLS

from fenics_tfeti.fem.decomposition.parts import find_equal, number_parts


def coordinates(row):
    return row.V.tabulate_dof_coordinates()[:, : row.mesh.geometry.dim]


@pytest.mark.parametrize("cell", CELLS)
def test_congruent_parts_have_equal_tables(cell):
    first, *others = row_of_boxes(cell).parts
    for part in others:
        np.testing.assert_array_equal(part.table, first.table)


@pytest.mark.parametrize("cell", CELLS)
def test_nodes_of_congruent_parts_correspond(cell):
    row = row_of_boxes(cell)
    x = coordinates(row)
    along = np.eye(x.shape[1])[0]
    for number, part in enumerate(row.parts):
        np.testing.assert_allclose(x[part.nodes], x[row.parts[0].nodes] + number * along)


def test_unlike_subdomains_keep_the_order_of_the_mesh():
    """Nothing is sorted where no other subdomain has as many cells and nodes."""
    row = row_of_boxes()
    cells = [np.arange(5, dtype=np.int32), np.arange(5, 36, dtype=np.int32)]
    for part, own in zip(number_parts(row.V, cells, [0, 0]), cells, strict=True):
        assert part.shape is None
        np.testing.assert_array_equal(part.cells, own)


@pytest.mark.parametrize("cell", CELLS)
def test_parts_of_other_sizes_have_other_shapes(cell):
    """Blocks of a graded mesh have equally many nodes, and are no images of each other."""
    row = row_of_boxes(cell)
    cells = [part.cells for part in row.parts]
    row.mesh.geometry.x[:, 0] **= 2
    parts = number_parts(row.V, cells, [0] * NUMBER)
    assert len({part.shape for part in parts}) == NUMBER
    assert all(part.rotation is None for part in parts)


def test_equal_data_are_found():
    row = row_of_boxes()
    data = [np.floor(row.middle) % 2]
    assert find_equal(row.parts, coordinates(row), data, True, {}) == [0, 1, 0, 1]


def test_no_parts_are_equal_where_the_place_counts():
    row = row_of_boxes()
    assert find_equal(row.parts, coordinates(row), [], False, {}) == list(range(NUMBER))


@pytest.mark.parametrize(("distance", "equal"), [(1e-15, True), (1e-12, False)])
def test_coordinates_may_differ_by_rounding_only(distance, equal):
    row = row_of_boxes()
    x = coordinates(row).copy()
    x[row.parts[1].nodes[5], 0] += distance
    assert (find_equal(row.parts[:2], x, [], True, {}) == [0, 0]) is equal
