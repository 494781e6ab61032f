"""A displacement interpolated from another mesh: bodies that touch, any cells, any ranks."""

from mpi4py import MPI

import numpy as np
import pytest

from dolfinx import fem

from fenics_tfeti import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.displacement import fill_owned, owned_values
from fenics_tfeti.fem.other_mesh import interpolated
from fenics_tfeti.io import Box, boxes, displacement_space

COMM = MPI.COMM_WORLD
CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]


class Stacked:
    """Two boxes that touch where the last coordinate is 1, with a displacement of a degree."""

    def __init__(self, cell, n, degree, comm=COMM, at=0.0):
        dim = 2 if cell in CELLS[:2] else 3
        low, high = np.zeros(dim), np.ones(dim)
        lift = np.eye(dim)[-1] + at
        parts = [Box(low, high, (n,) * dim), Box(low + lift, high + lift, (n + 1,) * dim)]
        mesh = boxes(comm, parts, cell).mesh
        self.u, self.bodies = (
            fem.Function(displacement_space(mesh, degree)),
            find_bodies(mesh, None),
        )
        x = self.u.function_space.tabulate_dof_coordinates()[:, :dim]
        cells = _compat.cell_dofs(self.u.function_space)
        is_upper = np.zeros((len(x), 1))
        is_upper[cells[: self.bodies.of_cell.size][self.bodies.of_cell == 1]] = 1.0
        field = np.stack([x[:, 0] + 2.0 * x[:, -1], 3.0 - x[:, 1]], axis=1)
        field = np.hstack([field, np.ones((len(x), dim - 2))])
        if degree == 2:
            field += x[:, :1] * x[:, -1:] + x[:, 1:2] ** 2
        # what is common to both has two values
        self.u.x.array[:] = (field + 5.0 * is_upper).ravel()
        self.expected = owned_values(fill_owned(self.u, owned_values(self.u)))


@pytest.mark.ranks(1, 2)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_polynomials_of_the_degree_are_exact(cell, degree):
    coarse, fine = Stacked(cell, 2, degree), Stacked(cell, 3, degree)
    found = interpolated(coarse.u, coarse.bodies, fine.u, fine.bodies)
    np.testing.assert_allclose(found, fine.expected, atol=1e-12)


@pytest.mark.ranks(2)
@pytest.mark.parametrize("comms", [(MPI.COMM_SELF, COMM), (COMM, MPI.COMM_SELF)])
def test_one_mesh_is_whole_on_each_rank(comms):
    coarse, fine = (Stacked("triangle", n, 1, comm) for n, comm in zip((2, 3), comms, strict=True))
    found = interpolated(coarse.u, coarse.bodies, fine.u, fine.bodies)
    np.testing.assert_allclose(found, fine.expected, atol=1e-12)


@pytest.mark.ranks(1, 2)
def test_nodes_outside_have_the_field_of_the_nearest_cell():
    """A body that is a little larger, as a round one with finer facets is."""
    coarse, fine = Stacked("quadrilateral", 2, 1), Stacked("triangle", 3, 1)
    coarse.u.function_space.mesh.geometry.x[:, 0] *= 0.95
    found = interpolated(coarse.u, coarse.bodies, fine.u, fine.bodies)
    x = fine.u.function_space.tabulate_dof_coordinates()[: found.size // 2, 0]
    np.testing.assert_allclose(found[::2], fine.expected[::2] + x * (1 / 0.95 - 1), atol=1e-12)
    np.testing.assert_allclose(found[1::2], fine.expected[1::2], atol=1e-12)


@pytest.mark.ranks(1, 2)
def test_body_in_another_place():
    coarse, fine = Stacked("triangle", 2, 1, at=5.0), Stacked("triangle", 2, 1)
    with pytest.raises(InputError, match=r"no cells where body 1 in \[0, 1\] x \[1, 2\] is"):
        interpolated(coarse.u, coarse.bodies, fine.u, fine.bodies)
