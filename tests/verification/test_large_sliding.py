"""Bodies that slide by many facets in steps: the work done on them is the energy they store.

The balance is closed by the passes over the deformed geometry (the forces act where and in the
direction that the deformed surfaces say) and by the trapezoidal rule over the steps.
"""

from __future__ import annotations

import numpy as np
import pytest
from large_sliding import MASTER, SLAVE, cam, pushed_block, rolling
from stepped_blocks import two_blocks

from fenics_tfeti import Exact

pytestmark = pytest.mark.once

heavy = pytest.mark.heavy


# the demo of a cam is the small form
@heavy
@pytest.mark.parametrize("slave", [SLAVE, MASTER])
@pytest.mark.parametrize(
    ("move", "arguments"),
    [(cam, {"steps": 24}), (rolling, {"steps": 40}), (pushed_block, {"steps": 48})],
)
def test_work_is_the_energy_stored(move, arguments, slave):
    way = move(slave=slave, **arguments)
    assert way.miss < 0.01
    # the follower rises, the wheel and the block go up and down
    assert np.abs(way.work).max() > 10.0 * way.energy.min()


@heavy
def test_nothing_is_lost_over_the_bump():
    """With the default tolerance; the block stands on a flat part in the end."""
    way = pushed_block(48, geometry=Exact(tolerance=1e-3, max_passes=40))
    assert abs(way.work[-1]) < 0.015 * way.work.max()
    assert abs(way.drive[-1]) < 0.01 * way.drive.max()


def test_sliding_on_a_plane_moves_the_force_along():
    """The gaps hardly change, but the force on the master acts at another place."""
    options = {"rtol": 1e-8}
    slid = two_blocks(0.3, options, upper=9, height=0.0, geometry=Exact())
    there = two_blocks(0.3, options, upper=9, height=0.0, start=0.3)
    slid.solve()
    there.solve()
    found, expected = (problem.report.contacts[0] for problem in (slid, there))
    force = expected.force_on_master
    np.testing.assert_allclose(found.force_on_master, force, atol=5e-3 * abs(force[1]))
    np.testing.assert_allclose(found.moment_on_master, expected.moment_on_master, rtol=5e-3)
