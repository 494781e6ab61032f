"""The nodes of a space: numbers, owners and values."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import vector_space

from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_WORLD
BODIES = [Box((0, 0), (1, 1), (6, 4)), Box((0, 1), (1, 2), (6, 4))]


def places(comm: MPI.Intracomm, cell: str, degree: int) -> dict[int, tuple[float, ...]]:
    """Return the coordinates of all nodes by their numbers."""
    space = vector_space(boxes(comm, BODIES, cell).mesh, degree)
    x = np.round(space.tabulate_dof_coordinates()[:, :2], 9) + 0.0
    own = zip(NodeMap(space).input_numbers.tolist(), map(tuple, x.tolist()), strict=False)
    parts = comm.allgather(list(own))
    found = dict(entry for part in parts for entry in part)
    assert len(found) == sum(map(len, parts))
    return found


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_same_numbers_as_on_one_process(cell, degree):
    assert places(COMM, cell, degree) == places(MPI.COMM_SELF, cell, degree)


@pytest.fixture(name="nodes")
def node_map() -> NodeMap:
    return NodeMap(vector_space(boxes(COMM, BODIES, "triangle").mesh))


def test_local_and_global_numbers(nodes):
    local = np.arange(nodes.size)
    np.testing.assert_array_equal(nodes.to_local(nodes.to_global(local)), local)


def test_values_at_nodes_of_all_ranks(nodes):
    """Each rank asks for every third node, the last one for none."""
    number = COMM.allreduce(nodes.owned)
    asked = np.arange(COMM.rank, number, 3)[::-1]
    if COMM.rank == COMM.size - 1:
        asked = asked[:0]
    own = nodes.first + np.arange(nodes.owned)
    found = nodes.values_at(np.column_stack([own, own**2]), asked)
    np.testing.assert_array_equal(found, np.column_stack([asked, asked**2]))


def test_values_of_all_ranks_are_summed_at_the_owners(nodes):
    number = COMM.allreduce(nodes.owned)
    rows = np.arange(number)
    own = nodes.first + np.arange(nodes.owned)
    total = nodes.sum_at_owners(np.append(rows, 0), np.append(rows, 5))
    np.testing.assert_array_equal(total, COMM.size * (own + 5 * (own == 0)))
    largest = nodes.sum_at_owners(rows, rows + COMM.rank, np.maximum)
    np.testing.assert_array_equal(largest, own + COMM.size - 1)
