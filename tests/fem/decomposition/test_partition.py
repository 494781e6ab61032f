"""Subdomains are connected, of about the wanted size, and equal blocks where cells form a grid."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from fenics_tfeti import InputError
from fenics_tfeti.fem.decomposition.bodies import find_bodies
from fenics_tfeti.fem.decomposition.partition import given_subdomains, split_into_subdomains
from fenics_tfeti.io import Box, boxes, displacement_space


def cube(n, cell="hexahedron"):
    return boxes(MPI.COMM_SELF, [Box((0, 0, 0), (1, 1, 1), (n, n, n))], cell).mesh


def split(mesh, unknowns, *partitioner):
    space = displacement_space(mesh)
    return split_into_subdomains(space, find_bodies(mesh, None), unknowns, *partitioner)


def test_blocks_are_equal():
    parts = split(cube(12, "tetrahedron"), 1000)
    assert {part.size for part in parts} == {6 * 6**3}


def test_scotch_can_be_asked_for():
    mesh = cube(16)
    sizes = {part.size for part in split(mesh, 2200, "scotch")}
    assert {part.size for part in split(mesh, 2200)} == {512}
    assert sizes != {512}


@pytest.mark.parametrize("partitioner", ["auto", "scotch"])
def test_subdomains_are_connected_and_cover_all_cells(partitioner):
    mesh = cube(9)
    parts = split(mesh, 600, partitioner)
    graph = find_bodies(mesh, None).graph
    assert sorted(np.concatenate(parts)) == list(range(9**3))
    assert all(connected_components(graph[part][:, part])[0] == 1 for part in parts)


def test_no_subdomain_is_in_two_bodies():
    parts = [Box((0, 0), (1, 1), (4, 4)), Box((0, 1), (1, 2), (4, 4))]
    mesh = boxes(MPI.COMM_SELF, parts, "quadrilateral").mesh
    assert [part.size for part in split(mesh, 10**6)] == [16, 16]


def test_cells_of_one_label_are_one_subdomain():
    mesh = cube(4)
    label = np.arange(4**3) // 32
    found = given_subdomains(mesh, find_bodies(mesh, None), label)
    assert sum(part.size for part in found) == 4**3
    assert all(np.unique(label[part]).size == 1 for part in found)


def test_label_of_separate_cells_gives_several_subdomains():
    mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (5, 1), (5, 1))], "quadrilateral").mesh
    label = np.zeros(5, dtype=int)
    graph = find_bodies(mesh, None).graph
    middle = np.argmax(np.diff(graph.indptr) == 2)  # a cell with two neighbours
    label[middle] = 1
    assert len(given_subdomains(mesh, find_bodies(mesh, None), label)) == 3


def test_wrong_number_of_labels_is_refused():
    mesh = cube(2)
    with pytest.raises(InputError, match=r"shape \(3,\), but rank 0 owns 8 cells"):
        given_subdomains(mesh, find_bodies(mesh, None), [0, 1, 2])
