"""Cells cover what the master covers, once, in the nearest layer."""

import numpy as np
import pytest
from facet_grids import chain, grid

from fenics_tfeti.fem.geometry.cells import MasterTree, covering_cells
from fenics_tfeti.fem.geometry.facets import Facets, Planes


def cells_of(slave, master):
    planes, tree = Planes.of(slave.coordinates()), MasterTree(master)
    reach = tree.reach(slave, planes)
    return covering_cells(slave, planes, np.arange(len(slave)), tree, reach)


def join(*surfaces):
    first = np.cumsum([0, *(len(s.points) for s in surfaces)])
    corners = [s.corners + at for s, at in zip(surfaces, first[:-1], strict=True)]
    return Facets(np.concatenate([s.points for s in surfaces]), np.concatenate(corners))


def at_height(z, **kwargs):
    return grid((5, 6), height=lambda x, y: 0.0 * x + z, **kwargs)


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("of_master", [3, 4])
def test_whole_surface_is_covered_once(corners, of_master):
    slave = grid((4, 3), corners=corners, jitter=0.5)
    master = grid((5, 7), (-1, -1), (2, 2), up=False, corners=of_master, jitter=0.5, seed=1)
    cells = cells_of(slave, master)
    covered = np.bincount(cells.slave, cells.pair_area, len(slave))
    assert np.allclose(covered, Planes.of(slave.coordinates()).area, rtol=1e-12)


def test_overhang_is_not_covered():
    cells = cells_of(chain(np.linspace(0, 1, 5)), chain(np.linspace(0.3, 2, 7), up=False))
    assert np.isclose(cells.area.sum(), 0.7)


@pytest.mark.parametrize("z", [1e-3, 0.4])
def test_nearest_of_two_layers(z):
    near, far = at_height(z, up=False), at_height(z + 0.3, up=False)
    cells = cells_of(grid((4, 4)), join(far, near))
    assert (cells.master >= len(far)).all()
    assert np.isclose(cells.area.sum(), 1.0)
    assert np.allclose(cells.height, z)


def test_layer_behind_that_overlaps_is_nearest():
    near, far = at_height(-0.01, up=False), at_height(0.3, up=False)
    assert np.allclose(cells_of(grid((4, 4)), join(far, near)).height, -0.01)


def test_parts_of_the_master_beside_each_other_all_count():
    left = grid((3, 3), high=(0.4, 1.0), up=False)
    right = grid((3, 3), low=(0.6, 0.0), up=False)
    assert np.isclose(cells_of(grid((2, 2)), join(left, right)).area.sum(), 0.8)


def test_far_side_of_the_slave_body_is_not_in_contact():
    """The master is a plate below the slave's body; its lower face looks down as the slave's."""
    top, bottom = at_height(-2.0), at_height(-3.0, up=False)
    assert not cells_of(grid((4, 4)), join(top, bottom)).slave.size


def test_deep_overlap_counts_inside_the_master():
    """The slave's surface is inside the plate, deeper than facets are large."""
    top, bottom = at_height(1.0), at_height(-0.8, up=False)
    cells = cells_of(grid((4, 4)), join(top, bottom))
    assert np.isclose(cells.area.sum(), 1.0) and np.allclose(cells.height, -0.8)


def test_centre_and_gap_of_pairs():
    slave = chain([0.0, 1.0])
    cells = cells_of(slave, chain([0.0, 0.5, 1.0], lambda x: 0.1 + x, up=False))
    middle, gap = cells.centre
    order = np.argsort(gap)
    assert np.allclose(gap[order], [0.35, 0.85])
    # along the segment, from its middle, towards falling x
    assert np.allclose(middle[order, 0], [0.25, -0.25])
