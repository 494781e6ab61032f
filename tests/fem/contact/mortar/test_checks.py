"""Surfaces that mortar conditions cannot couple."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scenes import MASTER, SLAVE, at
from strips import bend, matched, strips

from fenics_tfeti import ContactPair
from fenics_tfeti.errors import InputError
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets


def test_surfaces_that_never_meet():
    V, tags = strips((4, 2), (3, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + [5.0, 0.0, 0.0])
    with pytest.raises(InputError, match="contact 0 .*never meet"):
        matched(V, ContactPair(tags, SLAVE, MASTER))


def test_surfaces_that_face_away():
    tagged = boxes(
        MPI.COMM_SELF, [Box((0, 0), (1, 1), (4, 2)), Box((0, 1), (1, 2), (3, 2))], "quadrilateral"
    )
    tags = tag_facets(
        tagged.mesh, [(MASTER, at(1, 1.0), 1), (SLAVE, at(1, 2.0), 2)], tagged.cell_tags
    )
    with pytest.raises(InputError, match="face away .*far side"):
        matched(displacement_space(tagged.mesh), ContactPair(tags, SLAVE, MASTER))


def test_slivers_alone():
    V, tags = strips((4, 2), (3, 2))
    bend(V, lambda x: x[:, 1] > 1.05, lambda x: x + [1.0 - 1e-4, 0.0, 0.0])
    with pytest.raises(InputError, match=r"slivers of 1 slave facets.*\(0.9999, 1.1\)"):
        matched(V, ContactPair(tags, SLAVE, MASTER))


@pytest.mark.parametrize(("height", "folded"), [(0.4, False), (0.6, True)])
def test_folds(height, folded):
    """The slave's face has an edge in its middle, of slopes below and above 45 degrees."""
    V, tags = strips((4, 2), (2, 2))
    middle = lambda x: np.isclose(x[:, 0], 0.5) & np.isclose(x[:, 1], 1.1)  # noqa: E731
    bend(V, middle, lambda x: x - [0.0, height, 0.0])
    pair = ContactPair(tags, SLAVE, MASTER)
    if not folded:
        assert matched(V, pair).summary["pairs"] == 3
        return
    with pytest.raises(InputError, match=r"folded by more than 90 degrees at 1 .*\(0.5, 0.5\)"):
        matched(V, pair)
