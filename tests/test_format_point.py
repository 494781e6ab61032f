"""How coordinates look in messages."""

from __future__ import annotations

import numpy as np
import pytest

from fenics_tfeti.errors import format_point


@pytest.mark.parametrize(
    ("point", "written"),
    [
        ((0.5, 1.0, 0.0), "(0.5, 1, 0)"),
        ((1.38777878e-17, 0.25), "(0, 0.25)"),
        ((-1e-17, 1.0), "(0, 1)"),
        ((1 / 3, 2 / 3, 1.0), "(0.333333, 0.666667, 1)"),
        ((1.5e-9, 1e-9, 1e-25), "(1.5e-09, 1e-09, 0)"),
        ((123456.7, 2e-3), "(123457, 0)"),
        ((2e7, 0.0), "(2e+07, 0)"),
        ((0.0, 0.0, 0.0), "(0, 0, 0)"),
        ((np.nan, 1.0), "(nan, 1)"),
        ((np.inf, 1.0), "(inf, 1)"),
        ((5e-324, 0.0), "(4.94066e-324, 0)"),
    ],
)
def test_rounding_errors_are_not_shown(point, written):
    assert format_point(np.array(point)) == written


def test_what_is_small_against_the_surroundings_is_zero():
    assert format_point((1.4e-17, -3e-18), size=2.0) == "(0, 0)"
