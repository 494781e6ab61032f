import numpy as np
import pytest
from torn import cube

from fenics_tfeti import FactorizationError
from fenics_tfeti.feti import Subdomain
from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.local.fixing_nodes import fixing_nodes
from fenics_tfeti.feti.local.generalized_inverse import GeneralizedInverse, regularized_stiffness
from fenics_tfeti.feti.local.rigid_body_modes import kernel

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
    F = unknowns(fixing_nodes(CUBE.coordinates, R, 8))
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


def test_indefinite_matrix_is_refused():
    wrong = Subdomain(-CUBE.stiffness, CUBE.load, CUBE.coordinates, CUBE.nodes, 0)
    with pytest.raises(FactorizationError, match="positive"):
        GeneralizedInverse(wrong, R, available_packages()[0])
