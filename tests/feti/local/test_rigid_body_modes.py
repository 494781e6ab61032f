"""Rigid body modes, the kernel of K_i, and rigid motions in words."""

import dataclasses
import itertools

import numpy as np
import pytest
import scipy.sparse as sp
from torn import cube

from fenics_tfeti.feti.local.rigid_body_modes import (
    describe_motion,
    kernel,
    raw_modes,
    rigid_body_modes,
)

CUBE = cube(4)
K = CUBE.stiffness.toarray()


@pytest.mark.parametrize(
    ("pole", "parts", "words"),
    [
        ((0, 0), [0, -3, 0], "translation along (0, -1)"),
        ((0, 2), [0, 0, 5], "rotation through (0, 2)"),
        ((0, 2), [0, 0.5, 1], "rotation through (-0.5, 2)"),
        ((-0.95, 1), [0, 0, 1], "rotation through (-0.95, 1)"),
        ((-1.05, 1), [0, 0, 1], "translation along (0, 1) with rotation through (1, 1)"),
        ((0, 2, 1), [0, 0, 0, 0, 0, 7], "rotation about the axis (0, 0, 1) through (0, 2, 1)"),
        (
            (0, 2, 1),
            [0, 0, 2, 0, 0, 1],
            "translation along (0, 0, 1) with rotation about the axis (0, 0, 1) through (0, 2, 1)",
        ),
    ],
)
def test_motion_in_words(pole, parts, words):
    """A rotation is named by the point or axis that it leaves in place; the centre is at 1."""
    nodes = np.array(list(itertools.product((0.0, 2.0), repeat=len(pole))))
    motion = raw_modes(nodes, np.array(pole, dtype=float)) @ parts
    assert describe_motion(nodes, motion) == words


def test_kernel():
    """An elastic support along z leaves the motions along x, along y and about z."""
    R = kernel(CUBE)
    np.testing.assert_allclose(K @ R, 0.0, atol=1e-13)
    np.testing.assert_allclose(R.T @ R, np.eye(6), atol=1e-14)
    spring = sp.diags(np.where(np.arange(len(K)) % 3 == 2, 0.1, 0.0))
    held = dataclasses.replace(CUBE, stiffness=(CUBE.stiffness + spring).tocsr())
    assert kernel(held).shape[1] == 3


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
def test_rigid_body_modes_at_any_size(scale):
    modes = rigid_body_modes(scale * CUBE.coordinates + 10.0)
    np.testing.assert_allclose(modes.T @ modes, np.eye(6), atol=1e-13)
