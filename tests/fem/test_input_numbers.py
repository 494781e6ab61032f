"""Numbers of nodes by the input of the mesh; the same on any ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import vector_space

from dolfinx.mesh import create_submesh

from fenics_tfeti.fem.input_numbers import input_numbers
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_WORLD

BODIES = [Box((0, 0), (1, 1), (6, 4)), Box((0, 1), (1, 2), (6, 4))]


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_numbers_are_distinct(cell, degree):
    space = vector_space(boxes(MPI.COMM_SELF, BODIES, cell).mesh, degree)
    numbers = input_numbers(space)
    assert np.unique(numbers).size == numbers.size == space.dofmap.index_map.size_local


def test_number_is_the_place_in_the_first_cell():
    space = vector_space(boxes(MPI.COMM_SELF, BODIES[:1], "quadrilateral").mesh)
    x = space.tabulate_dof_coordinates()
    numbers = input_numbers(space)
    (corner,) = np.flatnonzero(np.hypot(*x[:, :2].T) < 1e-12)
    assert numbers[corner] == 0
    # the uppermost row of cells begins with cell 18, whose new nodes are its third and fourth
    (left,) = np.flatnonzero(np.hypot(x[:, 0], x[:, 1] - 1.0) < 1e-12)
    assert numbers[left] == 18 * 4 + 2


def test_submesh_has_none():
    mesh = boxes(MPI.COMM_SELF, BODIES, "quadrilateral").mesh
    part = create_submesh(mesh, 2, np.arange(4, dtype=np.int32))[0]
    assert input_numbers(vector_space(part)) is None


def places(comm: MPI.Intracomm, cell: str, degree: int) -> dict[int, tuple[float, ...]]:
    """Return the coordinates of all nodes by their numbers."""
    space = vector_space(boxes(comm, BODIES, cell).mesh, degree)
    x = np.round(space.tabulate_dof_coordinates()[:, :2], 9) + 0.0
    own = zip(input_numbers(space).tolist(), map(tuple, x.tolist()), strict=False)
    parts = comm.allgather(list(own))
    found = dict(entry for part in parts for entry in part)
    assert len(found) == sum(map(len, parts))
    return found


@pytest.mark.ranks(2)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_same_numbers_as_on_one_process(cell, degree):
    assert places(COMM, cell, degree) == places(MPI.COMM_SELF, cell, degree)
