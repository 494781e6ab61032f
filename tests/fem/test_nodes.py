"""The nodes of a space: numbers, owners and values."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import vector_space

from dolfinx.mesh import create_submesh

from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.io import Box, boxes

BODIES = [Box((0, 0), (1, 1), (3, 2)), Box((0, 1), (1, 2), (3, 2))]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_numbers_are_distinct(cell, degree):
    space = vector_space(boxes(MPI.COMM_SELF, BODIES, cell).mesh, degree)
    numbers = NodeMap(space).input_numbers
    assert np.unique(numbers).size == numbers.size == space.dofmap.index_map.size_local


def test_number_is_the_place_in_the_first_cell():
    space = vector_space(boxes(MPI.COMM_SELF, BODIES[:1], "quadrilateral").mesh)
    x = space.tabulate_dof_coordinates()
    numbers = NodeMap(space).input_numbers
    (corner,) = np.flatnonzero(np.hypot(*x[:, :2].T) < 1e-12)
    assert numbers[corner] == 0
    # the upper row of cells begins with cell 3, whose new nodes are its third and fourth
    (left,) = np.flatnonzero(np.hypot(x[:, 0], x[:, 1] - 1.0) < 1e-12)
    assert numbers[left] == 3 * 4 + 2


def test_submesh_has_none():
    mesh = boxes(MPI.COMM_SELF, BODIES, "quadrilateral").mesh
    part = create_submesh(mesh, 2, np.arange(4, dtype=np.int32))[0]
    assert NodeMap(vector_space(part)).input_numbers is None


def test_values_at_owners_on_one_process():
    nodes = NodeMap(vector_space(boxes(MPI.COMM_SELF, BODIES, "triangle").mesh))
    values = np.arange(2.0 * nodes.size).reshape(-1, 2)
    asked = np.array([[3, 1], [1, 0]])
    np.testing.assert_array_equal(nodes.values_at(values, asked), values[asked])


def test_values_are_summed_or_maximised_by_node():
    nodes = NodeMap(vector_space(boxes(MPI.COMM_SELF, BODIES, "triangle").mesh))
    rows = np.array([4, 2, 4])
    for ufunc, expected in ((np.add, [0, 0, 2, 0, 4]), (np.maximum, [0, 0, 2, 0, 3])):
        found = nodes.sum_at_owners(rows, np.array([1, 2, 3]), ufunc)
        np.testing.assert_array_equal(found[:5], expected)
        assert not found[5:].any()
