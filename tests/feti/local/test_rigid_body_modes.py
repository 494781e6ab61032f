"""Rigid motions in words: a rotation is named by the point or axis that it leaves where it is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fenics_tfeti.feti.local.rigid_body_modes import describe_motion, raw_modes


@pytest.mark.parametrize(
    ("pole", "parts", "words"),
    [
        ((0, 0), [0, -3, 0], "translation along (0, -1)"),
        ((0, 2), [0, 0, 5], "rotation through (0, 2)"),
        ((0, 2), [0, 0.5, 1], "rotation through (-0.5, 2)"),
        ((-19, 1), [0, 0, 1], "translation along (0, 1) with rotation through (1, 1)"),
        ((0, 2, 1), [0, 0, 0, 0, 0, 7], "rotation about the axis (0, 0, 1) through (0, 2, 1)"),
        (
            (0, 2, 1),
            [0, 0, 2, 0, 0, 1],
            "translation along (0, 0, 1) with rotation about the axis (0, 0, 1) through (0, 2, 1)",
        ),
    ],
)
def test_motion_in_words(pole, parts, words):
    """The centre of the nodes is (1, 1) or (1, 1, 1)."""
    nodes = np.array(list(itertools.product((0.0, 2.0), repeat=len(pole))))
    motion = raw_modes(nodes, np.array(pole, dtype=float)) @ parts
    assert describe_motion(nodes, motion) == words
