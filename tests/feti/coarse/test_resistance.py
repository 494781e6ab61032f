"""Motions that rows resist weakly or not at all, against singular values of the dense matrix."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.linalg import block_diag

from fenics_tfeti.feti.coarse.resistance import sum_sparse, weak_motions

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD

MODES, BODIES = 6, 9
BELOW, UNRESISTED = 1e-4, 1e-12


def rows_of(bodies: list[tuple[int, ...]], each: int, seed: int = 0) -> np.ndarray:
    """Return random rows of unit length, some for each tuple of bodies that they act on."""
    rng = np.random.default_rng(seed)
    B = np.zeros((each * len(bodies), MODES * BODIES))
    for number, members in enumerate(bodies):
        for body in members:
            at = slice(MODES * body, MODES * (body + 1))
            B[number * each : (number + 1) * each, at] = rng.standard_normal((each, MODES))
    return B / np.linalg.norm(B, axis=1)[:, None]


def held_by_each_other(bodies: int, loose: int) -> np.ndarray:
    """Return random rows between all of some bodies, which leave so many motions free."""
    size = MODES * bodies
    rows = np.random.default_rng(3).standard_normal((size - loose, size))
    return rows / np.linalg.norm(rows, axis=1)[:, None]


# body 0 is held; 1 to 3 form a chain on it; 4 and 5 hold each other; 6 is held in four of its
# modes, 7 in one of them firmly and in another one weakly; 8 is loose
FEW = np.vstack(
    [
        rows_of([(0,), (0, 1), (1, 2), (2, 3)], each=8),
        rows_of([(4, 5)], each=9, seed=1),
        rows_of([(6,)], each=4, seed=2),
        [np.eye(MODES * BODIES)[7 * MODES], 3e-7 * np.eye(MODES * BODIES)[7 * MODES + 1]],
    ]
)
LOOSE = 3 + 2 + 4 + 6
# forty more are too many for dense algebra; inverse iteration begins with eight vectors, and
# leaves a quarter of all motions to dense algebra after all
scenes = pytest.mark.parametrize(
    ("B", "loose"),
    [(FEW, LOOSE)] + [(block_diag(FEW, held_by_each_other(40, k)), LOOSE + k) for k in (2, 9, 60)],
    ids=["few", "two more", "nine more", "sixty more"],
)


def found(B: np.ndarray, supports: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the motions of rows, with elastic supports of some bodies."""
    of_bodies = np.zeros((B.shape[1] // MODES, MODES, MODES))
    for body, support in supports.items():
        of_bodies[body] = support
    weak = weak_motions(MPI.COMM_SELF, sp.csr_matrix(B), of_bodies, BELOW, UNRESISTED)
    return weak.values, weak.motions.toarray()


@scenes
def test_resistance_is_that_of_the_singular_values(B, loose):
    exact = np.linalg.svd(B, compute_uv=False)
    exact = np.append(exact, np.zeros(B.shape[1] - exact.size))
    values, z = found(B, {})
    assert values.size == loose + 1
    np.testing.assert_allclose(np.sort(values), np.sort(exact)[: loose + 1], atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(B @ z, axis=0), values, atol=1e-13)
    np.testing.assert_allclose(z.T @ z, np.eye(loose + 1), atol=1e-13)


@scenes
def test_motions_of_one_body_move_no_other(B, loose):
    """Translations of a body come first."""
    z = found(B, {})[1]
    bodies = np.abs(z).reshape(-1, MODES, loose + 1).max(axis=1) > 0.0
    number = np.count_nonzero(bodies, axis=0)
    # 6, 7 and 8 by themselves, 4 and 5 together
    assert np.count_nonzero(number == 1) == LOOSE + 1 - 3
    assert np.count_nonzero(number == 2) == 3
    assert np.count_nonzero(number > 2) == loose - LOOSE
    assert not bodies[:4].any()
    alone = z[8 * MODES : 9 * MODES, bodies[8] & (number == 1)]
    np.testing.assert_allclose(alone[3:, :3], 0.0, atol=1e-15)
    np.testing.assert_allclose(alone[:3, 3:], 0.0, atol=1e-15)


@scenes
def test_elastic_supports_resist(B, loose):
    values, z = found(B, {8: np.diag([1.0, 0.1, 0.01, 1e-3, 2e-5, 0.0])})
    assert values.size == loose + 1 - 4
    expected = np.append(np.zeros(loose - 5), [3e-7, 2e-5])
    np.testing.assert_allclose(np.sort(values), expected, atol=1e-13)
    np.testing.assert_allclose(np.abs(z[8 * MODES + 5]).max(), 1.0, atol=1e-13)


def test_motions_of_many_bodies_together():
    """A long chain that nothing holds, by inverse iteration: six motions of the whole."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal((40, 3))
    rows = []
    for i in range(39):
        for _ in range(7):
            point, normal = 0.5 * (x[i] + x[i + 1]) + rng.standard_normal(3), rng.standard_normal(3)
            row = np.zeros(240)
            row[6 * i : 6 * i + 6] = np.append(normal, np.cross(point, normal))
            row[6 * i + 6 : 6 * i + 12] = -row[6 * i : 6 * i + 6]
            rows.append(row / np.linalg.norm(row))
    values, z = found(np.array(rows), {})
    together = np.tile(np.eye(6), (40, 1)) / np.sqrt(40.0)
    np.testing.assert_allclose(values, np.zeros(6), atol=1e-13)
    np.testing.assert_allclose(z @ (z.T @ together), together, atol=1e-12)


def test_no_bodies():
    weak = weak_motions(
        MPI.COMM_SELF, sp.csr_matrix((0, 0)), np.zeros((0, 6, 6)), BELOW, UNRESISTED
    )
    assert weak.values.shape == (0,) and weak.motions.shape == (0, 0)


@pytest.mark.ranks(2, 3)
@pytest.mark.parametrize("bodies", [5, 40])
def test_rows_on_several_ranks(bodies):
    """By dense algebra, and by inverse iteration."""
    rng = np.random.default_rng(0)
    # a chain of bodies that nothing holds, and one that is held in two modes
    rows = np.zeros((7 * bodies - 5, 6 * bodies + 6))
    for i in range(bodies - 1):
        block, at = slice(7 * i, 7 * i + 7), 6 * i
        rows[block, at : at + 6] = rng.standard_normal((7, 6))
        rows[block, at + 6 : at + 12] = -rows[block, at : at + 6]
    rows[-2:, -6:] = rng.standard_normal((2, 6))
    own = sp.csr_matrix(rows[COMM.rank :: COMM.size])
    weak = weak_motions(COMM, own, np.zeros((bodies + 1, 6, 6)), 1e-4, 1e-12)
    dense = weak.motions.toarray()
    assert weak.values.size == 6 + 4
    np.testing.assert_allclose(rows @ dense, 0.0, atol=1e-13)
    np.testing.assert_allclose(dense.T @ dense, np.eye(10), atol=1e-13)
    assert all(np.array_equal(dense, other) for other in COMM.allgather(dense))


@pytest.mark.ranks(2, 3)
def test_sum_of_sparse_matrices():
    own = sp.csr_matrix(np.diag([1.0, 0.0, COMM.rank]))
    expected = np.diag([COMM.size, 0.0, COMM.size * (COMM.size - 1) / 2])
    np.testing.assert_array_equal(sum_sparse(COMM, own).toarray(), expected)
