from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from torn import cube

from fenics_tfeti import FactorizationError
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.feti.local.cholesky import available_packages
from fenics_tfeti.feti.local.fixing_nodes import fixing_nodes, perron_centres, split_nodes
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse, regularized_stiffness
from fenics_tfeti.feti.local.rigid_body_modes import describe_motion, kernel, rigid_body_modes

CUBE = cube(4)
K = CUBE.stiffness.toarray()
R = kernel(CUBE)

ways = pytest.mark.parametrize("package", available_packages())


def unknowns(nodes):
    return (3 * np.asarray(nodes)[:, None] + np.arange(3)).ravel()


@ways
def test_generalized_inverse(package):
    """K K^+ K = K (11.28)."""
    inverse = GeneralizedInverse(CUBE, R, package)
    scale = np.abs(K).max()
    np.testing.assert_allclose(K @ inverse.solve(K), K, atol=1e-11 * scale)


def test_regularisation_is_the_block_elimination_of_the_chapter():
    """(K + rho Q)^{-1} against (11.32)-(11.34) with S^+ = (S + rho Q)^{-1}, all dense."""
    F = unknowns(fixing_nodes(CUBE.stiffness, CUBE.coordinates, 8))
    rest = np.setdiff1d(np.arange(len(K)), F)
    L = np.linalg.cholesky(K[np.ix_(rest, rest)])
    L_F = np.linalg.solve(L, K[np.ix_(rest, F)]).T
    S = K[np.ix_(F, F)] - L_F @ L_F.T
    Q = R[F] @ np.linalg.inv(R[F].T @ R[F]) @ R[F].T
    S_inverse = np.linalg.inv(S + K.diagonal().max() * Q)
    L_inverse = np.linalg.inv(L)
    left = np.block(
        [
            [L_inverse.T, -L_inverse.T @ L_F.T @ S_inverse],
            [np.zeros((len(F), len(rest))), S_inverse],
        ]
    )
    right = np.block(
        [[L_inverse, np.zeros((len(rest), len(F)))], [-L_F @ L_inverse, np.eye(len(F))]]
    )
    order = np.argsort(np.concatenate([rest, F]))
    chapter = (left @ right)[np.ix_(order, order)]
    ours = np.linalg.inv(regularized_stiffness(CUBE.stiffness, R, F).toarray())
    np.testing.assert_allclose(ours, chapter, atol=1e-9 * np.abs(chapter).max())


def test_kernel():
    np.testing.assert_allclose(K @ R, 0.0, atol=1e-13)
    np.testing.assert_allclose(R.T @ R, np.eye(6), atol=1e-14)


def test_elastic_support_takes_motions_out_of_the_kernel():
    spring = sp.diags(np.where(np.arange(len(K)) % 3 == 2, 0.1, 0.0))
    held = Subdomain((CUBE.stiffness + spring).tocsr(), CUBE.load, CUBE.coordinates, CUBE.nodes, 0)
    assert kernel(held).shape[1] == 3  # along x, along y, about z


def test_fixing_nodes_condition_better_than_corners():
    """The condition number of K_RR, with 8 fixing nodes of algorithm 11.1 against 8 corners."""

    def condition(nodes):
        rest = np.setdiff1d(np.arange(len(K)), unknowns(nodes))
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


def test_indefinite_matrix_is_refused():
    wrong = Subdomain(-CUBE.stiffness, CUBE.load, CUBE.coordinates, CUBE.nodes, 0)
    with pytest.raises(FactorizationError, match="positive"):
        GeneralizedInverse(wrong, R, available_packages()[0])


@pytest.mark.parametrize(
    ("mode", "words"),
    [(2, "translation along (0, 0, 1)"), (5, "rotation about the axis (0, 0, 1)")],
)
def test_motions_in_words(mode, words):
    from fenics_tfeti.feti.local.rigid_body_modes import raw_modes

    x = CUBE.coordinates
    assert words in describe_motion(x, raw_modes(x, x.mean(axis=0))[:, mode])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_rigid_body_modes_at_any_size(scale):
    modes = rigid_body_modes(scale * CUBE.coordinates + 10.0)
    np.testing.assert_allclose(modes.T @ modes, np.eye(6), atol=1e-13)
