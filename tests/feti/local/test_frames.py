"""Components in the frames of subdomains."""

import numpy as np
import pytest
from scipy.stats import ortho_group

from fenics_tfeti.feti.local.frames import Frames, in_frame, out_of_frame

pytestmark = pytest.mark.once

TURNS = ortho_group.rvs(3, size=4, random_state=0)


def blocks(turn, nodes, others):
    return np.block(
        [
            [np.kron(np.eye(nodes), turn), np.zeros((3 * nodes, others))],
            [np.zeros((others, 3 * nodes)), np.eye(others)],
        ]
    )


def test_vectors_and_columns():
    x = np.random.default_rng(0).random((15, 2))
    expected = blocks(TURNS[0], 5, 0).T @ x
    np.testing.assert_allclose(in_frame(x, TURNS[0]), expected)
    np.testing.assert_allclose(in_frame(x[:, 0], TURNS[0]), expected[:, 0])
    np.testing.assert_allclose(out_of_frame(expected, TURNS[0]), x)
    assert in_frame(x, None) is x
    assert out_of_frame(x, None) is x


def test_rows_with_unknowns_of_no_node():
    rows = np.random.default_rng(0).random((4, 17))
    turned = Frames(TURNS, 5).to_frame(rows)
    for row, expected, turn in zip(turned, rows, TURNS, strict=True):
        np.testing.assert_allclose(row, blocks(turn, 5, 2).T @ expected)
    np.testing.assert_allclose(Frames(TURNS, 5).from_frame(turned), rows)


def test_matrix_on_some_nodes():
    frames = Frames(TURNS, 5)
    unknowns = frames.whole_nodes(np.array([4, 12, 14, 16]))
    assert unknowns.tolist() == [3, 4, 5, 12, 13, 14, 16]
    matrix = frames.matrix(unknowns).toarray()
    for k, turn in enumerate(TURNS):
        np.testing.assert_allclose(
            matrix[7 * k : 7 * (k + 1), 7 * k : 7 * (k + 1)], blocks(turn, 2, 1)
        )
    assert np.count_nonzero(matrix) == 4 * (2 * 9 + 1)
    assert frames.matrix(np.zeros(0, dtype=np.int64)).shape == (0, 0)
