"""Cells are cut into connected parts of nearly equal size, as round as their body allows."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition import round_parts
from fenics_tfeti.fem.decomposition.bodies import cell_graph, components
from fenics_tfeti.fem.decomposition.round_parts import cut_into_slabs, mean_aspect, rounded
from fenics_tfeti.io import Box, boxes


def cells_of(size, divisions, cell):
    """Return the graph of a box of cells, and their midpoints."""
    mesh = boxes(MPI.COMM_SELF, [Box((0,) * len(size), size, divisions)], cell).mesh
    corners = mesh.geometry.x[_compat.geometry_cells(mesh), : len(size)]
    return cell_graph(mesh), corners.mean(axis=1)


def facets_between(graph, part):
    edges = graph.tocoo()
    return np.count_nonzero(part[edges.row] != part[edges.col]) // 2


def adjacency(cells, edges):
    """Return the graph of cells with the given edges."""
    row, column = np.transpose(edges)
    graph = sp.csr_matrix((np.ones(len(edges)), (row, column)), shape=(cells, cells))
    return sp.csr_matrix(graph + graph.T)


SHAPES = [
    ((1.0, 2.0, 3.0), (4, 8, 12), "tetrahedron"),
    ((1.0, 1.0, 1.0), (8, 8, 8), "hexahedron"),
    ((1.0, 1.0), (16, 16), "triangle"),
    ((9.0, 1.0), (54, 6), "quadrilateral"),
]


@pytest.mark.parametrize("parts", [1, 2, 7])
@pytest.mark.parametrize(("size", "divisions", "cell"), SHAPES)
def test_parts_are_connected_and_of_equal_size(size, divisions, cell, parts):
    graph, midpoints = cells_of(size, divisions, cell)
    part = cut_into_slabs(graph, midpoints, parts)
    sizes = np.bincount(part)
    assert parts / 2.4 <= sizes.size <= 2.4 * parts
    assert sizes.min() > 0.8 * sizes.mean() and sizes.max() < 1.2 * sizes.mean()
    assert components(graph, part)[0] == sizes.size


@pytest.mark.parametrize(
    ("length", "parts", "numbers"),
    [
        ((2.0, 1.0, 1.0), 10, (4, 2, 2)),  # 10 parts cannot be round, 16 are cubes
        ((2.0, 1.0, 1.0), 2, (2, 1, 1)),
        ((9.0, 3.0, 0.1), 27, (9, 3, 1)),  # a plate
        ((100.0, 1.0, 1.0), 7, (16, 1, 1)),
        ((1.0, 1.0, 1.0), 1e6, (100, 100, 100)),
        ((5.0, 0.0), 5, (5, 1)),  # points along a line
        ((0.0, 0.0), 3, (3, 1)),
    ],
)
def test_numbers_of_slabs_make_round_parts(length, parts, numbers):
    assert round_parts._numbers_of_slabs(np.array(length), parts) == numbers


def test_boxes_are_cut_into_equal_cubes():
    """Of which the factors are shared, also where grids are not looked for."""
    graph, midpoints = cells_of((2.0, 1.0, 1.0), (16, 8, 8), "hexahedron")
    part = cut_into_slabs(graph, midpoints, 10)
    cubes = np.unique(np.column_stack([part, np.floor(2 * midpoints)]), axis=0)
    assert len(cubes) == 16 == part.max() + 1


@pytest.mark.parametrize(("size", "divisions", "cell"), SHAPES)
def test_parts_of_scotch_are_rounded(size, divisions, cell):
    graph, midpoints = cells_of(size, divisions, cell)
    label = _compat.partition_graph(graph.indptr, graph.indices, 10).astype(np.int64)
    part = rounded(graph, midpoints, label)
    sizes = np.bincount(part)
    before, after = (mean_aspect(graph, midpoints, parts) for parts in (label, part))
    assert after < before
    assert components(graph, part)[0] == sizes.size and sizes.max() < 1.5 * sizes.mean()


def test_aspect_of_blocks_and_of_sheets():
    graph, midpoints = cells_of((1.0, 1.0, 1.0), (8, 8, 8), "hexahedron")
    whole = np.zeros(len(midpoints), dtype=np.int64)
    assert mean_aspect(graph, midpoints, whole) == pytest.approx(1.0)
    halves, sheets = (np.floor(n * midpoints[:, 0]).astype(np.int64) for n in (2, 8))
    assert mean_aspect(graph, midpoints, halves) == pytest.approx(2.0)
    assert mean_aspect(graph, midpoints, sheets) == pytest.approx(8.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cuts_are_across_the_longest_axis(axis):
    size, divisions = np.ones(3), np.full(3, 4)
    size[axis], divisions[axis] = 4.0, 16
    graph, midpoints = cells_of(tuple(size), tuple(int(n) for n in divisions), "hexahedron")
    part = cut_into_slabs(graph, midpoints, 4)
    quarter = np.floor(midpoints[:, axis]).astype(int)
    assert len({(int(k), int(q)) for k, q in zip(part, quarter, strict=True)}) == 4


def test_cuts_are_across_an_inclined_body():
    graph, midpoints = cells_of((4.0, 1.0), (16, 4), "quadrilateral")
    turned = midpoints @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    assert facets_between(graph, cut_into_slabs(graph, turned, 2)) == 3 * 4  # squares


def test_interfaces_are_smaller_than_planes_cut_them():
    graph, midpoints = cells_of((1.0, 1.0, 1.0), (8, 8, 8), "tetrahedron")
    turned = midpoints @ np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    planes = [facets_between(graph, x > np.median(x)) for x in turned.T]
    assert facets_between(graph, cut_into_slabs(graph, turned, 2)) < 0.95 * min(planes)


def test_small_pieces_join_their_neighbours():
    # a row of twelve cells, and one beside it that touches the first one only
    graph = adjacency(13, [(i, i + 1) for i in range(11)] + [(0, 12)])
    midpoints = np.append(np.arange(12.0), 12.0)[:, None]
    part = cut_into_slabs(graph, midpoints, 2)
    assert part[12] == part[0]
    assert np.unique(part).size == 2


def test_large_pieces_stay_parts_of_their_own():
    # two rows side by side, joined at the left: the right half is in two pieces
    rows = [(i, i + 1) for i in range(19)] + [(20 + i, 21 + i) for i in range(19)]
    graph = adjacency(40, [*rows, (0, 20)])
    midpoints = np.tile(np.arange(20.0), 2)[:, None]
    part = cut_into_slabs(graph, midpoints, 2)
    assert np.unique(part).size == 3
    assert len({part[0], part[19], part[39]}) == 3


def test_small_pieces_beside_each_other_become_one():
    # a row of cells with alternating labels, so that each is a piece
    graph = adjacency(8, [(i, i + 1) for i in range(7)])
    part = round_parts._connected(graph, np.array([0, 1, 0, 1, 0, 1, 0, 1]), 1)
    assert part.max() < 4
    assert all(np.bincount(part) >= 2)


def test_parts_are_the_same_each_time():
    graph, midpoints = cells_of((1.0, 2.0, 3.0), (4, 8, 12), "tetrahedron")
    np.testing.assert_array_equal(
        cut_into_slabs(graph, midpoints, 9), cut_into_slabs(graph, midpoints, 9)
    )
