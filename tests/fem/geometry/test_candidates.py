"""Candidates are found at any distance, and only where facets face each other."""

import numpy as np
import pytest
from facet_grids import chain, grid

from fenics_tfeti.fem.geometry.cells import MasterTree
from fenics_tfeti.fem.geometry.facets import Planes


def candidates(slave, master):
    planes, tree = Planes.of(slave.coordinates()), MasterTree(master)
    chosen = np.arange(len(slave.pieces))
    return tree.candidates(slave, chosen, planes, tree.reach(slave, planes))


@pytest.mark.parametrize("gap", [0.0, 0.1, 50.0, -0.3])
def test_facets_opposite_are_found_and_not_those_around_them(gap):
    slave = grid((4, 4), corners=4)
    master = grid((4, 4), height=lambda x, y: 0.0 * x + gap, up=False, corners=4)
    at, other = candidates(slave, master)
    np.testing.assert_array_equal(at, np.arange(16))
    np.testing.assert_array_equal(other, np.arange(16))


def test_each_pair_once_in_the_slave_order():
    slave, master = grid((3, 5)), grid((7, 4), up=False)
    at, other = candidates(slave, master)
    assert (np.diff(at) >= 0).all()
    assert len({*zip(at.tolist(), other.tolist(), strict=True)}) == at.size


def test_surfaces_that_face_away():
    assert not candidates(grid((2, 2)), grid((2, 2)))[0].size


def test_small_master_within_a_large_facet():
    slave = chain([0.0, 10.0])
    master = chain(np.linspace(4.9, 5.1, 11), lambda x: 0.0 * x + 3.0, up=False)
    assert candidates(slave, master)[1].size == 10


def test_steep_surface():
    """At 60 degrees the gap along the normal is twice the distance."""
    slave = chain([0.0, 1.0])
    master = chain(np.linspace(-100.0, 100.0, 401), lambda x: 8.0 + np.sqrt(3.0) * x, up=False)
    at, other = candidates(slave, master)
    low, high = np.sort(master.coordinates()[other][..., 0], axis=1).T
    assert ((low <= 0.5) & (high >= 0.5)).any()
