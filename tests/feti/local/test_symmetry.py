"""Symmetries of subdomains: signed permutations that leave the stiffness matrix as it is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.sparse as sp
from springs import on_springs
from torn import cube

from fenics_tfeti.feti.local.symmetry import SymmetryGroup, find_symmetries

pytestmark = pytest.mark.once


def lattice(*shape: int) -> np.ndarray:
    return np.array(list(itertools.product(*(range(n + 1) for n in shape))), dtype=float)


def truss(x: np.ndarray, reach: float) -> sp.csr_matrix:
    """Return the stiffness of rods of equal stiffness between all nodes within reach."""
    nodes, gdim = x.shape
    K = np.zeros((nodes, gdim, nodes, gdim))
    for i, j in itertools.combinations(range(nodes), 2):
        rod = x[j] - x[i]
        if np.linalg.norm(rod) <= reach:
            block = np.outer(rod, rod) / (rod @ rod)
            K[i, :, i] += block
            K[j, :, j] += block
            K[i, :, j] -= block
            K[j, :, i] -= block
    return sp.csr_matrix(K.reshape(nodes * gdim, -1))


def order(x: np.ndarray, reach: float = 1.5) -> int:
    return find_symmetries(truss(x, reach), x).order


def matrices(group: SymmetryGroup) -> list[np.ndarray]:
    n = group.images.shape[1]
    found = []
    for image, sign in zip(group.images, group.signs, strict=True):
        Q = np.zeros((n, n))
        Q[image, np.arange(n)] = sign
        found.append(Q)
    return found


def test_a_cube_is_the_same_in_three_mirrors():
    part = cube(2, (4, -3, 7))
    group = find_symmetries(part.stiffness, part.coordinates)
    K, elements = part.stiffness.toarray(), matrices(group)
    assert group.order == 8
    for Q in elements:
        np.testing.assert_allclose(Q @ K @ Q.T, K, atol=1e-12 * np.abs(K).max())
    for (i, one), (j, other) in itertools.product(enumerate(elements), repeat=2):
        np.testing.assert_array_equal(one @ other, elements[i ^ j])


@pytest.mark.parametrize("shape", [(3, 2), (2, 2), (4, 1, 2), (1, 1, 1)])
def test_boxes_have_a_mirror_for_each_direction(shape):
    assert order(lattice(*shape)) == 2 ** len(shape)


def test_nodes_that_are_off_are_seen():
    x = lattice(2, 2)
    x[4] += [1e-9, 0.0]
    assert order(x) == 2
    assert order(x + 0.1 * np.random.default_rng(0).random((9, 2)), 2.0) == 1


def test_exchanged_axes_where_mirrors_fail():
    """A square cut by parallel diagonals: turned by pi, and the axes exchanged."""
    x = lattice(3, 3)
    K = truss(x, 1.0).toarray()
    right, top = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for i, j in itertools.permutations(range(len(x)), 2):
        if np.array_equal(x[j] - x[i], right + top):
            rod = np.concatenate([-(right + top), right + top]) / np.sqrt(2)
            at = np.concatenate([2 * i + np.arange(2), 2 * j + np.arange(2)])
            K[np.ix_(at, at)] += np.outer(rod, rod)
    group = find_symmetries(sp.csr_matrix(K), x)
    assert group.order == 4
    for Q in matrices(group):
        np.testing.assert_allclose(Q @ K @ Q.T, K, atol=1e-14)


@pytest.mark.parametrize(("size", "expected"), [(0.0, 8), (1e-13, 4)])
def test_a_soft_spring_on_one_side_is_seen(size, expected):
    part = on_springs(cube(2), 0.0, size)
    assert find_symmetries(part.stiffness, part.coordinates).order == expected


def test_further_unknowns_than_those_of_nodes_have_none():
    x = lattice(2, 2)
    K = sp.block_diag([truss(x, 1.5), sp.identity(3)], format="csr")
    group = find_symmetries(K, x)
    assert group.order == 1
    np.testing.assert_array_equal(group.images, [np.arange(21)])


@pytest.mark.parametrize(("chosen", "expected"), [
    (lambda x: x[:, 0] >= 0, 8),
    (lambda x: x[:, 0] == 0, 4),
    (lambda x: (x[:, 0] == 0) | (x[:, 0] == 1), 8),
    (lambda x: (x[:, 0] == 0) | (x[:, 1] == 0), 2),
    (lambda x: x.sum(axis=1) == 0, 1),
])  # fmt: skip
def test_subgroup_of_some_nodes(chosen, expected):
    part = cube(2)
    group = find_symmetries(part.stiffness, part.coordinates)
    some = np.flatnonzero(np.repeat(chosen(part.coordinates), 3))
    within = group.on(some)
    assert within.order == expected
    whole = {Q[np.ix_(some, some)].tobytes() for Q in matrices(group)}
    assert {Q.tobytes() for Q in matrices(within)} <= whole


def test_images_of_nodes():
    x = lattice(2, 1)
    images = find_symmetries(truss(x, 1.5), x).nodes(2)
    assert {tuple(image) for image in images.tolist()} == {
        (0, 1, 2, 3, 4, 5),
        (4, 5, 2, 3, 0, 1),
        (1, 0, 3, 2, 5, 4),
        (5, 4, 3, 2, 1, 0),
    }
