"""Derivatives by preloads of bolts, jumps of periodic pairs and motions of rigid bodies."""

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
from sensitivity_scenes import (
    block_on_roller,
    of_constant,
    of_mesh,
    of_motion,
    of_tie,
    periodic_block,
    taylor,
    tied_stack,
)

from fenics_tfeti import BoltPreload, Coulomb, InputError, RigidBody

MOVED = RigidBody((0.45, -2.0), translation=(1e-3, 2e-3), rotation=1e-3, spring=(0.1, 0.1, 0.0))
KINDS = {
    "force of a bolt": (partial(tied_stack, kind=BoltPreload, upper=5, force=-3e-3), of_tie),
    "shortening": (partial(tied_stack, kind=BoltPreload, upper=5, shortening=2e-3), of_tie),
    "periodic pair": (periodic_block, of_tie),
    "motion": (partial(block_on_roller, body=MOVED), of_motion),
    "motion, Coulomb": (partial(block_on_roller, Coulomb(0.3), body=MOVED), of_motion),
}


@pytest.mark.parametrize("kind", KINDS)
def test_remainder_of_second_order(kind):
    make, parameter = KINDS[kind]
    scene = make()
    scene.solve()
    rates, same = taylor(scene, parameter(scene, 2e-4))
    assert same
    assert np.all(np.abs(rates - 2.0) < 0.05), rates


OTHER_DATA = {
    "traction": lambda scene: of_constant(scene.traction, 1e-4),
    "nodes": lambda scene: of_mesh(scene, 1e-4),  # both sides of cuts alike
}
# the sides of a periodic pair are as far apart as it was told
CASES = [(k, name) for k in KINDS for name in OTHER_DATA if (k, name) != ("periodic pair", "nodes")]


@pytest.mark.heavy
@pytest.mark.parametrize(("kind", "name"), CASES)
def test_other_data(kind, name):
    scene = KINDS[kind][0]()
    scene.solve()
    rates, same = taylor(scene, OTHER_DATA[name](scene))
    assert same
    assert np.all(np.abs(rates - 2.0) < 0.05), rates


def test_no_bolt():
    scene = block_on_roller(comm=MPI.COMM_WORLD)
    scene.solve()
    with pytest.raises(InputError, match="'joint' is no bolt"):
        scene.adjoint().by_preload("joint")
