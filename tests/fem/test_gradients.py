"""Displacement gradients in cells, and what Newton's method reads off them."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import block, mesh_of
from scenes import CELLS

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.gradients import CellGradients
from fenics_tfeti.io import displacement_space

REFERENCE = {"triangle": 1 / 2, "tetrahedron": 1 / 6, "quadrilateral": 1.0, "hexahedron": 1.0}

by_cell_and_degree = pytest.mark.parametrize(
    ("cell", "degree"), [(cell, degree) for cell in CELLS for degree in (1, 2)]
)


def linear_field(cell, degree, stretch=()):
    """Return the gradients of a mesh of distorted cells, A, and A x (nodes, gdim)."""
    points, cells = block(cell)
    random, d = np.random.default_rng(3), points.shape[1]
    domain = mesh_of(MPI.COMM_SELF, cell, points + 0.1 * random.random(points.shape), cells)
    A = np.diag(np.array(stretch)[:d]) if stretch else random.standard_normal((d, d))
    space = displacement_space(domain, degree)
    return CellGradients(space), A, space.tabulate_dof_coordinates()[:, :d] @ A.T


@by_cell_and_degree
def test_gradient_of_a_linear_field(cell, degree):
    gradients, A, u = linear_field(cell, degree)
    for batch in gradients.at_midpoints(u):
        np.testing.assert_allclose(
            batch.fields[0][:, 0], np.broadcast_to(A, (len(batch.nodes), *A.shape)), atol=1e-12
        )


@pytest.mark.parametrize("cell", CELLS)
def test_volume(cell):
    points, cells = block(cell)
    space = displacement_space(mesh_of(MPI.COMM_SELF, cell, points, cells))
    u = np.zeros((_compat.cell_dofs(space).max() + 1, points.shape[1]))
    volume = sum(batch.scale.sum() for batch in CellGradients(space).at_midpoints(u))
    assert REFERENCE[cell] * volume == pytest.approx(np.prod(np.ptp(points, axis=0)))


@by_cell_and_degree
def test_increment_is_relative_to_the_deformed_state(cell, degree):
    gradients, A, u = linear_field(cell, degree)
    turned = 0.5 * A @ np.linalg.inv(np.eye(len(A)) + A)
    expected = np.linalg.norm(turned), abs(np.trace(turned @ turned))
    assert gradients.largest_increment(u, 0.5 * u) == pytest.approx(expected)


@by_cell_and_degree
def test_cells_that_are_turned_inside_out(cell, degree):
    gradients, _, u = linear_field(cell, degree, (-3.0, 0.0, 0.0))
    assert gradients.smallest_volume_ratio(u)[0] == pytest.approx(-2.0)
