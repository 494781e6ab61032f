"""Fields made on several ranks have their values at ghosts, too."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.errors import InputError
from fenics_tfeti.io import Box, boxes, piecewise_constant

comm = MPI.COMM_WORLD


@pytest.fixture
def bodies():
    """Return boxes below and above z = 1, with the tags 1 and 2."""
    parts = [Box((0, 0, z), (4, 1, z + 1), (8, 2, 2)) for z in (0, 1)]
    return boxes(comm, parts)


def test_piecewise_constant_is_that_of_the_body_in_all_cells_of_a_rank(bodies):
    E = piecewise_constant(bodies.mesh, bodies.cell_tags, {1: 3.0, 2: 5.0})
    space = E.function_space
    size = space.dofmap.index_map.size_local + space.dofmap.index_map.num_ghosts
    z = space.tabulate_dof_coordinates()[:size, 2]
    assert E.x.array.size == size
    assert np.array_equal(E.x.array, np.where(z < 1.0, 3.0, 5.0))


def test_a_tag_without_a_value_is_an_error_on_all_ranks(bodies):
    with pytest.raises(InputError, match="have no value"):
        piecewise_constant(bodies.mesh, bodies.cell_tags, {1: 3.0})
