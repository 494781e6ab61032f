"""Grids are found from coordinates, and cut into blocks that are equal where that comes out."""

from mpi4py import MPI

import numpy as np
import pytest

from dolfinx.mesh import CellType, create_box, create_rectangle

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.grid import block_of_cells, find_grid


def box(cells, cell="hexahedron", size=(1.0, 1.0, 1.0)):
    kind = getattr(CellType, cell)
    if len(cells) == 2:
        return create_rectangle(MPI.COMM_SELF, [(0, 0), size[:2]], cells, kind)
    return create_box(MPI.COMM_SELF, [(0, 0, 0), size], cells, kind)


def grid_of(mesh):
    return find_grid(mesh.geometry.x[:, : mesh.geometry.dim], _compat.geometry_cells(mesh))


@pytest.mark.parametrize(
    ("cells", "cell"),
    [
        ((4, 3, 2), "hexahedron"),
        ((4, 3, 2), "tetrahedron"),
        ((5, 2), "quadrilateral"),
        ((5, 2), "triangle"),
    ],
)
def test_a_box_is_a_grid(cells, cell):
    assert tuple(grid_of(box(cells, cell)).cells) == cells


def test_the_simplices_of_a_place_are_together():
    places = grid_of(box((2, 3, 4), "tetrahedron")).cell
    assert set(np.unique(places, axis=0, return_counts=True)[1]) == {6}


def test_a_graded_grid_is_one():
    mesh = box((4, 3, 2))
    mesh.geometry.x[:] **= 3
    assert tuple(grid_of(mesh).cells) == (4, 3, 2)


def test_a_corner_may_be_missing():
    mesh = box((6, 6), "quadrilateral")
    cells = _compat.geometry_cells(mesh)
    kept = cells[(mesh.geometry.x[cells][:, :, :2].mean(axis=1) < 0.5).any(axis=1)]
    nodes, kept = np.unique(kept, return_inverse=True)
    grid = find_grid(mesh.geometry.x[nodes, :2], kept.reshape(-1, 4))
    assert (len(grid.cell), *grid.cells) == (27, 6, 6)


def test_moved_nodes_are_no_grid():
    mesh = box((4, 3, 2))
    mesh.geometry.x[:] += 1e-4 * np.random.default_rng(0).standard_normal(mesh.geometry.x.shape)
    assert grid_of(mesh) is None


def test_an_annulus_is_no_grid():
    mesh = box((8, 4), "quadrilateral")
    angle, radius = np.pi * mesh.geometry.x[:, 0], 1.0 + mesh.geometry.x[:, 1]
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    assert grid_of(mesh) is None


def test_two_nodes_at_one_place_are_no_grid():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])
    assert find_grid(points, np.array([[0, 1, 2], [0, 1, 3]])) is None


@pytest.mark.parametrize(
    ("cells", "nodes", "blocks"),
    [
        ((32, 16, 16), 1000, (4, 2, 2)),
        ((20, 20, 20), 1000, (2, 2, 2)),
        ((17, 9, 9), 1000, (2, 1, 1)),
        ((8, 8, 8), 10_000, (1, 1, 1)),
        ((3, 3, 3), 1, (3, 3, 3)),
    ],
)
def test_blocks_come_out_even_where_they_can(cells, nodes, blocks):
    size = tuple(n / 16 for n in cells)
    grid = grid_of(box(cells, size=size))
    block = block_of_cells(grid, nodes)
    assert np.unique(block).size == np.prod(blocks)
    along = [grid.cell[block == 0][:, axis].max() + 1 for axis in range(3)]
    expected = [-(-n // count) for n, count in zip(cells, blocks, strict=True)]
    assert along == expected


def test_blocks_of_flat_cells_are_cubes_all_the_same():
    grid = grid_of(box((8, 8, 32)))
    block = block_of_cells(grid, 200)
    one = grid.cell[block == 0].max(axis=0) + 1
    assert (one == [4, 4, 16]).all()
