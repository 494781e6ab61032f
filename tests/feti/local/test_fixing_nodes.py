"""Fixing nodes of algorithm 11.1: near the centres of equal parts of a subdomain."""

import numpy as np
import pytest
from torn import cube

from fenics_tfeti.feti.local.fixing_nodes import fixing_nodes, split_nodes
from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.local.symmetry import find_symmetries

CUBE = cube(4)
K, R = CUBE.stiffness.toarray(), rigid_body_modes(CUBE.coordinates)


def test_fixing_nodes_condition_better_than_corners():
    """The condition number of K_RR, with 8 fixing nodes of algorithm 11.1 against 8 corners."""

    def condition(nodes):
        rest = np.flatnonzero(~np.isin(np.arange(len(K)) // 3, nodes))
        return np.linalg.cond(K[np.ix_(rest, rest)])

    corners = np.flatnonzero(np.all(np.isin(CUBE.coordinates, (0, 1)), axis=1))
    spread = fixing_nodes(CUBE.coordinates, R, 8)
    assert len(corners) == len(spread) == 8
    assert condition(spread) < 0.5 * condition(corners)


def test_fixing_nodes_lie_inside():
    x = cube(8).coordinates
    x = x[fixing_nodes(x, rigid_body_modes(x), 8)]
    assert np.all((x > 0) & (x < 1))


@pytest.mark.parametrize("parts", [1, 2, 3, 8, 125])
def test_split_covers_all_nodes_evenly(parts):
    pieces = split_nodes(CUBE.coordinates, parts)
    assert sorted(np.concatenate(pieces)) == list(range(125))
    assert max(map(len, pieces)) - min(map(len, pieces)) <= 2


def test_centres_of_a_path_and_of_a_ring():
    x = np.column_stack([np.arange(9.0), np.zeros(9)])
    assert fixing_nodes(x, np.ones((18, 1)), 1).tolist() == [4]
    angle = np.arange(12) * np.pi / 6
    x = np.column_stack([np.cos(angle), np.sin(angle)])
    chosen = fixing_nodes(x, rigid_body_modes(x), 3)
    assert chosen.size == 3
    assert np.all((chosen >= 0) & (chosen < 12))


def test_more_nodes_are_chosen_where_those_found_lie_on_a_line():
    """One node leaves all rotations free, and two leave the one about the line through them."""
    chosen = fixing_nodes(CUBE.coordinates, R, 1)
    assert chosen.size == 4
    edges = CUBE.coordinates[chosen[1:]] - CUBE.coordinates[chosen[0]]
    assert np.linalg.matrix_rank(edges) >= 2


def test_fixing_nodes_have_the_symmetries_of_the_mesh():
    images = find_symmetries(CUBE.stiffness, CUBE.coordinates).nodes(3)
    plain = fixing_nodes(CUBE.coordinates, R, 8)
    chosen = fixing_nodes(CUBE.coordinates, R, 8, images)
    assert any(set(image[plain]) != set(plain) for image in images)
    assert all(set(image[chosen]) == set(chosen) for image in images)
    assert 8 <= chosen.size <= 15
