"""Multipliers that balance the load, with contact forces that only press (lemma 11.1)."""

import dataclasses

import numpy as np
import pytest
from dense import DenseSystem
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Friction, Prescribed, TornSolver, TornSystem
from fenics_tfeti.feti.constraints.row_table import Kind

pytestmark = pytest.mark.once


@pytest.mark.parametrize("load", [(0, 0, -1.0), (0.3, -0.2, -2.0), (0, 0, 0)])
def test_feasible_start(load):
    """Nothing but contact forces holds the upper cube up; without load there are none."""
    solver = TornSolver(column(load=load))
    system, start = DenseSystem.of(solver), solver.data.feasible
    np.testing.assert_allclose(system.G @ start, system.R.T @ system.f, atol=1e-12)
    constraints = solver.setup.constraints
    multipliers = start[constraints.inequality]
    assert np.all(multipliers >= 0)
    assert np.sum(multipliers * constraints.rows.of(Kind.CONTACT).scale) == pytest.approx(
        -load[2], rel=1e-10
    )


def test_start_of_rigid_bodies():
    """A cube on four springs under an eccentric load, and one that stays open for its gap."""
    block = cube(1, load=(0.0, 0.0, -1.0))
    force = block.load.reshape(-1, 3)
    lower = np.flatnonzero(block.coordinates[:, 2] == 0.0)
    x, y = block.coordinates[:, 0], block.coordinates[:, 1]
    force[:, 2] = -(0.65 - 0.3 * x) * (0.65 - 0.3 * y) / 2.0
    side = np.concatenate([np.full(4, 0), np.full(4, 1)])
    slides = Prescribed(np.tile(block.nodes[lower], 2), side, np.zeros(8))
    down = np.tile([0.0, 0.0, -1.0], (4, 1))
    for gap, expected in ((0.0, [0.4, 0.25, 0.25, 0.1]), (9.0, [0.3, 0.35, 0.35, 0.0])):
        rows = ContactRows.node_to_node(
            block.nodes[lower],
            np.full(4, -1),
            down,
            np.array([0.0, 0.0, 0.0, gap]),
            np.zeros(4, int),
        )
        solver = TornSolver(
            TornSystem([dataclasses.replace(block, load=force.ravel())], slides, rows, 3)
        )
        constraints = solver.setup.constraints
        forces = (solver.data.feasible * constraints.lengths_of_rows())[constraints.inequality]
        np.testing.assert_allclose(forces, expected, atol=1e-8)


def test_open_contacts_with_friction_do_not_press():
    """A cube on the ground between two walls that would hold it by friction, were they closed."""
    block = cube(1, load=(0.0, 0.0, -1.0))
    x, _, z = block.coordinates.T
    nodes = [block.nodes[side] for side in (z == 0.0, x == 0.0, x == 1.0)]
    down, left = np.array([0.0, 0.0, -1.0]), np.array([-1.0, 0.0, 0.0])
    rows = ContactRows.node_to_node(
        np.concatenate(nodes),
        np.full(12, -1),
        np.repeat([down, left, -left], 4, axis=0),
        np.repeat([0.0, 9.0, 9.0], 4),
        np.repeat([0, 1, 2], 4),
    )
    across, up = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    tangents = np.repeat([[-left, across], [across, up], [across, up]], 4, axis=0)
    friction = Friction(np.arange(12), tangents, np.zeros(12), coefficient=np.full(12, 0.5))
    names = ["ground", "left", "right"]
    system = TornSystem([block], Prescribed(), rows, 3, contact_names=names, friction=friction)
    solver = TornSolver(system)
    constraints = solver.setup.constraints
    forces = (solver.data.feasible * constraints.lengths_of_rows())[constraints.inequality]
    np.testing.assert_allclose(forces, np.repeat([0.25, 0.0, 0.0], 4), atol=1e-8)
