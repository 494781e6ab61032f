"""The graph of cells, and its components of equal labels."""

from mpi4py import MPI

import numpy as np
import pytest

from fenics_tfeti.fem.decomposition.bodies import cell_graph, components, groups
from fenics_tfeti.io import Box, boxes


def graph_of(divisions, cell):
    box = Box((0,) * len(divisions), divisions, divisions)
    return cell_graph(boxes(MPI.COMM_SELF, [box], cell).mesh)


@pytest.mark.parametrize(
    ("cell", "divisions", "common_facets"),
    [
        ("quadrilateral", (3, 2), 7),
        ("triangle", (3, 2), 6 + 7),
        ("hexahedron", (3, 2, 2), 8 + 6 + 6),
        # six tetrahedra of a block have six common facets, two on each common side of blocks
        ("tetrahedron", (3, 2, 2), 6 * 12 + 2 * 20),
    ],
)
def test_each_common_facet_is_an_edge(cell, divisions, common_facets):
    graph = graph_of(divisions, cell)
    assert graph.nnz == 2 * common_facets
    assert (graph != graph.T).nnz == 0


def test_components_have_one_label_each():
    graph = graph_of((4, 1), "quadrilateral")
    order = np.argsort(np.diff(graph.indptr), kind="stable")  # the two ends first
    label = np.zeros(4, dtype=np.int64)
    label[order[2]] = 1
    number, component = components(graph, label)
    assert number == np.unique(component).size == 3


def test_groups_are_by_label():
    assert [g.tolist() for g in groups(np.array([2, 0, 2, 5]))] == [[1], [0, 2], [3]]


def test_no_cells_are_no_groups():
    assert groups(np.zeros(0, dtype=np.int64)) == []
