"""Planes cut cells into connected parts of equal size, whose interfaces are then smoothed."""

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition import bisection
from fenics_tfeti.fem.decomposition.bisection import bisect
from fenics_tfeti.fem.decomposition.bodies import cell_graph
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


@pytest.mark.parametrize("parts", [1, 2, 7])
@pytest.mark.parametrize(
    ("size", "divisions", "cell"),
    [
        ((1.0, 2.0, 3.0), (4, 8, 12), "tetrahedron"),
        ((1.0, 1.0, 1.0), (8, 8, 8), "hexahedron"),
        ((1.0, 1.0), (16, 16), "triangle"),
        ((9.0, 1.0), (54, 6), "quadrilateral"),
    ],
)
def test_parts_are_connected_and_of_equal_size(size, divisions, cell, parts):
    graph, midpoints = cells_of(size, divisions, cell)
    part = bisect(graph, midpoints, parts)
    sizes = np.bincount(part)
    assert sizes.size == parts
    assert sizes.min() > 0.8 * part.size / parts
    assert sizes.max() < 1.2 * part.size / parts
    assert all(connected_components(graph[part == k][:, part == k])[0] == 1 for k in range(parts))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cuts_are_across_the_longest_axis(axis):
    size, divisions = np.ones(3), np.full(3, 4)
    size[axis], divisions[axis] = 4.0, 16
    graph, midpoints = cells_of(tuple(size), tuple(int(n) for n in divisions), "hexahedron")
    part = bisect(graph, midpoints, 4)
    quarter = np.floor(midpoints[:, axis]).astype(int)
    assert len({(int(k), int(q)) for k, q in zip(part, quarter, strict=True)}) == 4


def test_cuts_are_across_an_inclined_body():
    graph, midpoints = cells_of((4.0, 1.0), (16, 4), "quadrilateral")
    turned = midpoints @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    assert facets_between(graph, bisect(graph, turned, 2)) == 4


def test_interfaces_are_smaller_than_planes_cut_them():
    graph, midpoints = cells_of((1.0, 1.0, 1.0), (8, 8, 8), "tetrahedron")
    turned = midpoints @ np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
    planes = [facets_between(graph, x > np.median(x)) for x in turned.T]
    assert facets_between(graph, bisect(graph, turned, 2)) < 0.95 * min(planes)


def test_small_pieces_join_their_neighbours():
    # a row of twelve cells, and one beside it that touches the first one only
    graph = adjacency(13, [(i, i + 1) for i in range(11)] + [(0, 12)])
    midpoints = np.append(np.arange(12.0), 12.0)[:, None]
    part = bisect(graph, midpoints, 2)
    assert part[12] == part[0]
    assert np.unique(part).size == 2


def test_large_pieces_stay_parts_of_their_own():
    # two rows side by side, joined at the left: the right half is in two pieces
    rows = [(i, i + 1) for i in range(19)] + [(20 + i, 21 + i) for i in range(19)]
    graph = adjacency(40, [*rows, (0, 20)])
    midpoints = np.tile(np.arange(20.0), 2)[:, None]
    part = bisect(graph, midpoints, 2)
    assert np.unique(part).size == 3
    assert len({part[0], part[19], part[39]}) == 3


def test_small_pieces_beside_each_other_become_one():
    # a row of cells with alternating labels, so that each is a piece
    graph = adjacency(8, [(i, i + 1) for i in range(7)])
    part = bisection._connected(graph, np.array([0, 1, 0, 1, 0, 1, 0, 1]), 1)
    assert part.max() < 4
    assert all(np.bincount(part) >= 2)


def test_parts_are_the_same_each_time():
    graph, midpoints = cells_of((1.0, 2.0, 3.0), (4, 8, 12), "tetrahedron")
    np.testing.assert_array_equal(bisect(graph, midpoints, 9), bisect(graph, midpoints, 9))
