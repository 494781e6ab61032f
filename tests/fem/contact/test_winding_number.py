"""How often a closed surface winds around points."""

from __future__ import annotations

import numpy as np
import pytest

from fenics_tfeti.fem.contact.solution.apart import winding_number

# corners of a unit square, and of a unit cube, seen from outside against the clock
SQUARE = np.array([[[0, 0], [1, 0]], [[1, 0], [1, 1]], [[1, 1], [0, 1]], [[0, 1], [0, 0]]], float)
FACES = np.array(
    [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
)
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)
TRIANGLES = np.concatenate([FACES[:, [0, 1, 2]], FACES[:, [0, 2, 3]]])
SURFACES = {"square": SQUARE, "quadrilaterals": CORNERS[FACES], "triangles": CORNERS[TRIANGLES]}


@pytest.mark.parametrize("name", SURFACES)
def test_one_inside_and_none_outside(name):
    corners = SURFACES[name]
    x = np.random.default_rng(0).uniform(-1.0, 2.0, (500, corners.shape[2]))
    is_inside = ((x > 0.0) & (x < 1.0)).all(axis=1)
    np.testing.assert_allclose(winding_number(x, corners), is_inside, atol=1e-12)
    assert is_inside.any()


def test_half_on_a_face():
    assert winding_number(np.array([[0.5, 0.5, 0.0]]), SURFACES["triangles"]) == pytest.approx(0.5)
