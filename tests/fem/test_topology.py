"""Facets of cells, and which of them are on the boundary."""

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import block, mesh_of
from scenes import CELLS

from dolfinx import cpp

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.topology import (
    cell_facets,
    cell_type,
    cell_vertices,
    cells_of_facets,
    exterior_cell_facets,
    exterior_facets,
    facet_corners,
    owned_cells,
    vertex_nodes,
)

every_cell = pytest.mark.parametrize("cell", CELLS)
# facets of a square's or cube's surface of 3 x 3 (x 3) units
EXTERIOR = {"triangle": 12, "quadrilateral": 12, "tetrahedron": 108, "hexahedron": 54}


def mesh(cell):
    return mesh_of(MPI.COMM_SELF, cell, *block(cell))


@every_cell
def test_cell_type(cell):
    assert cell_type(mesh(cell)).name == cell


@every_cell
def test_all_cells_of_one_rank_are_owned(cell):
    assert owned_cells(mesh(cell)) == len(block(cell)[1])


@every_cell
@pytest.mark.parametrize("degree", [1, 2])
def test_vertices_are_the_first_nodes_of_spaces(cell, degree):
    domain = mesh(cell)
    space = _compat.lagrange_space(domain, degree)
    x = space.tabulate_dof_coordinates()[vertex_nodes(space)]
    np.testing.assert_allclose(x, domain.geometry.x[cell_vertices(domain)], atol=1e-15)


@every_cell
def test_facets_have_the_vertices_that_the_reference_cell_says(cell):
    domain = mesh(cell)
    facets = cell_facets(domain)
    of_cell = cell_vertices(domain)[:, np.array(cell_type(domain).facets)]
    dim = domain.topology.dim - 1
    domain.topology.create_connectivity(dim, dim + 1)
    vertices = cpp.mesh.entities_to_geometry(_compat.cpp_object(domain), dim, facets.ravel(), False)
    vertices = np.reshape(vertices, of_cell.shape)
    np.testing.assert_array_equal(np.sort(vertices, axis=2), np.sort(of_cell, axis=2))


@every_cell
def test_number_of_exterior_facets(cell):
    assert np.count_nonzero(exterior_facets(mesh(cell))) == EXTERIOR[cell]


@every_cell
def test_corners_of_no_facets(cell):
    domain = mesh(cell)
    corners = facet_corners(domain, *cells_of_facets(domain, np.empty(0, dtype=np.int32)))
    assert corners.shape == (0, cell_type(domain).facet.vertices)


@every_cell
def test_exterior_facets_of_cells_are_on_the_surface(cell):
    domain = mesh(cell)
    exterior = exterior_cell_facets(domain)
    found = cell_facets(domain)[exterior]
    x = domain.geometry.x[facet_corners(domain, *cells_of_facets(domain, found))]
    x = x[:, :, : domain.geometry.dim]
    on_side = np.all(x == 0.0, axis=1) | np.all(x == 3.0, axis=1)
    assert exterior.sum() == EXTERIOR[cell]
    assert on_side.any(axis=1).all()
