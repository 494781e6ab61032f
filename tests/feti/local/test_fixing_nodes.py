"""Fixing nodes of algorithm 11.1: near the centres of equal parts of a subdomain."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from torn import cube

from fenics_tfeti.feti.local.fixing_nodes import (
    fixing_nodes,
    node_graph,
    perron_centres,
    split_nodes,
)
from fenics_tfeti.feti.local.symmetry import find_symmetries

CUBE = cube(4)
K = CUBE.stiffness.toarray()


def test_nodes_of_one_element_are_neighbours():
    graph = node_graph(cube(2).stiffness, 3).toarray()
    corner, centre = graph[0], graph[13]
    assert np.flatnonzero(corner).tolist() == [0, 1, 3, 4, 9, 10, 12, 13]
    assert centre.tolist() == [1.0] * 27


def test_fixing_nodes_condition_better_than_corners():
    """The condition number of K_RR, with 8 fixing nodes of algorithm 11.1 against 8 corners."""

    def condition(nodes):
        rest = np.flatnonzero(~np.isin(np.arange(len(K)) // 3, nodes))
        return np.linalg.cond(K[np.ix_(rest, rest)])

    corners = np.flatnonzero(np.all(np.isin(CUBE.coordinates, (0, 1)), axis=1))
    spread = fixing_nodes(CUBE.stiffness, CUBE.coordinates, 8)
    assert len(corners) == len(spread) == 8
    assert condition(spread) < 0.5 * condition(corners)


def test_fixing_nodes_lie_inside():
    fine = cube(8)
    x = fine.coordinates[fixing_nodes(fine.stiffness, fine.coordinates, 8)]
    assert np.all((x > 0) & (x < 1))


@pytest.mark.parametrize("parts", [1, 2, 3, 8, 125])
def test_split_covers_all_nodes_evenly(parts):
    pieces = split_nodes(CUBE.coordinates, parts)
    assert sorted(np.concatenate(pieces)) == list(range(125))
    assert max(map(len, pieces)) - min(map(len, pieces)) <= 2


def test_perron_centre_of_a_path_is_its_middle():
    path = sp.diags([np.ones(8), np.ones(9), np.ones(8)], [-1, 0, 1], format="csr")
    assert perron_centres(path, np.zeros(9, dtype=int)).tolist() == [4]


def test_perron_centre_of_a_part_is_in_its_largest_piece():
    """Nodes 0 and 4 to 8 are a part that the other cuts in two."""
    path = sp.diags([np.ones(8), np.ones(9), np.ones(8)], [-1, 0, 1], format="csr")
    part = np.array([1, 0, 0, 0, 1, 1, 1, 1, 1])
    assert perron_centres(path, part).tolist() == [2, 6]


def test_more_nodes_are_chosen_where_those_found_lie_on_a_line():
    """One node leaves all rotations free, and two leave the one about the line through them."""
    chosen = fixing_nodes(CUBE.stiffness, CUBE.coordinates, 1)
    assert chosen.size == 4
    edges = CUBE.coordinates[chosen[1:]] - CUBE.coordinates[chosen[0]]
    assert np.linalg.matrix_rank(edges) >= 2


def test_fixing_nodes_have_the_symmetries_of_the_mesh():
    images = find_symmetries(CUBE.stiffness, CUBE.coordinates).nodes(3)
    plain = fixing_nodes(CUBE.stiffness, CUBE.coordinates, 8)
    chosen = fixing_nodes(CUBE.stiffness, CUBE.coordinates, 8, images)
    assert any(set(image[plain]) != set(plain) for image in images)
    assert all(set(image[chosen]) == set(chosen) for image in images)
    assert 8 <= chosen.size <= 15
