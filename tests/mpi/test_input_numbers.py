"""Numbers of nodes by the input of the mesh: the same on any ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import vector_space

from fenics_tfeti.fem.input_numbers import input_numbers
from fenics_tfeti.io import Box, boxes

COMM = MPI.COMM_WORLD
BODIES = [Box((0, 0), (1, 1), (6, 4)), Box((0, 1), (1, 2), (6, 4))]


def places(comm: MPI.Intracomm, cell: str, degree: int) -> dict[int, tuple[float, ...]]:
    """Return the coordinates of all nodes by their numbers."""
    space = vector_space(boxes(comm, BODIES, cell).mesh, degree)
    x = np.round(space.tabulate_dof_coordinates()[:, :2], 9) + 0.0
    own = zip(input_numbers(space).tolist(), map(tuple, x.tolist()), strict=False)
    parts = comm.allgather(list(own))
    found = dict(entry for part in parts for entry in part)
    assert len(found) == sum(map(len, parts))
    return found


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_same_numbers_as_on_one_process(cell, degree):
    assert places(COMM, cell, degree) == places(MPI.COMM_SELF, cell, degree)
