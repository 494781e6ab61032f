"""The nodes of a space: numbers, owners and values."""

from __future__ import annotations

import gc
import weakref

from mpi4py import MPI

import numpy as np
import pytest

from dolfinx.mesh import create_submesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.nodes import MeshComm, NodeMap
from fenics_tfeti.io import Box, boxes, displacement_space

COMM = MPI.COMM_WORLD

BODIES = [Box((0, 0), (1, 1), (6, 4)), Box((0, 1), (1, 2), (6, 4))]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_numbers_are_distinct(cell, degree):
    space = displacement_space(boxes(MPI.COMM_SELF, BODIES, cell).mesh, degree)
    numbers = NodeMap(space).input_numbers
    assert np.unique(numbers).size == numbers.size == space.dofmap.index_map.size_local


def test_number_is_the_place_in_the_first_cell():
    space = displacement_space(boxes(MPI.COMM_SELF, BODIES[:1], "quadrilateral").mesh)
    x = space.tabulate_dof_coordinates()
    numbers = NodeMap(space).input_numbers
    (corner,) = np.flatnonzero(np.hypot(*x[:, :2].T) < 1e-12)
    assert numbers[corner] == 0
    # the uppermost row of cells begins with cell 18, whose new nodes are its third and fourth
    (left,) = np.flatnonzero(np.hypot(x[:, 0], x[:, 1] - 1.0) < 1e-12)
    assert numbers[left] == 18 * 4 + 2


def test_nodes_of_a_submesh_are_numbered_by_its_cells():
    mesh = boxes(MPI.COMM_SELF, BODIES, "quadrilateral").mesh
    part = create_submesh(mesh, 2, np.arange(4, dtype=np.int32))[0]
    space = displacement_space(part)
    numbers, cells = NodeMap(space).input_numbers, _compat.cell_dofs(space)
    np.testing.assert_array_equal(numbers[cells[0]], np.arange(4))
    assert np.unique(numbers).size == numbers.size and numbers.max() < 4 * len(cells)


def test_values_at_owners_on_one_process():
    nodes = NodeMap(displacement_space(boxes(MPI.COMM_SELF, BODIES, "triangle").mesh))
    values = np.arange(2.0 * nodes.size).reshape(-1, 2)
    asked = np.array([[3, 1], [1, 0]])
    np.testing.assert_array_equal(nodes.values_at(values, asked), values[asked])


def test_values_are_summed_or_maximised_by_node():
    nodes = NodeMap(displacement_space(boxes(MPI.COMM_SELF, BODIES, "triangle").mesh))
    rows = np.array([4, 2, 4])
    for ufunc, expected in ((np.add, [0, 0, 2, 0, 4]), (np.maximum, [0, 0, 2, 0, 3])):
        found = nodes.reduce_at_owners(rows, np.array([1, 2, 3]), ufunc)
        np.testing.assert_array_equal(found[:5], expected)
        assert not found[5:].any()


def places(comm: MPI.Intracomm, cell: str, degree: int) -> dict[int, tuple[float, ...]]:
    """Return the coordinates of all nodes by their numbers."""
    space = displacement_space(boxes(comm, BODIES, cell).mesh, degree)
    x = np.round(space.tabulate_dof_coordinates()[:, :2], 9) + 0.0
    own = zip(NodeMap(space).input_numbers.tolist(), map(tuple, x.tolist()), strict=False)
    parts = comm.allgather(list(own))
    found = dict(entry for part in parts for entry in part)
    assert len(found) == sum(map(len, parts))
    return found


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_same_numbers_as_on_one_process(cell, degree):
    assert places(COMM, cell, degree) == places(MPI.COMM_SELF, cell, degree)


@pytest.fixture(name="nodes")
def node_map() -> NodeMap:
    return NodeMap(displacement_space(boxes(COMM, BODIES, "triangle").mesh))


@pytest.mark.ranks(2, 3)
def test_local_and_global_numbers(nodes):
    local = np.arange(nodes.size)
    np.testing.assert_array_equal(nodes.to_local(nodes.to_global(local)), local)


@pytest.mark.ranks(2, 3)
def test_values_at_nodes_of_all_ranks(nodes):
    """Each rank asks for every third node, the last one for none."""
    number = COMM.allreduce(nodes.owned)
    asked = np.arange(COMM.rank, number, 3)[::-1]
    if COMM.rank == COMM.size - 1:
        asked = asked[:0]
    own = nodes.first + np.arange(nodes.owned)
    found = nodes.values_at(np.column_stack([own, own**2]), asked)
    np.testing.assert_array_equal(found, np.column_stack([asked, asked**2]))


@pytest.mark.ranks(2, 3)
def test_values_of_all_ranks_are_summed_at_the_owners(nodes):
    number = COMM.allreduce(nodes.owned)
    rows = np.arange(number)
    own = nodes.first + np.arange(nodes.owned)
    total = nodes.reduce_at_owners(np.append(rows, 0), np.append(rows, 5))
    np.testing.assert_array_equal(total, COMM.size * (own + 5 * (own == 0)))
    largest = nodes.reduce_at_owners(rows, rows + COMM.rank, np.maximum)
    np.testing.assert_array_equal(largest, own + COMM.size - 1)


@pytest.mark.ranks(2)
def test_communicator_outlives_the_script_s_mesh():
    mesh = boxes(COMM, BODIES, "triangle").mesh
    alive, comm = weakref.ref(mesh), MeshComm(mesh)
    del mesh
    gc.collect()
    assert alive() is not None
    assert comm.allreduce(1) == COMM.size
    del comm
    gc.collect()
    assert alive() is None
