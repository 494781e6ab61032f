"""Multipliers that balance the load, with contact forces that only press (lemma 11.1)."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dense import DenseSystem
from scipy.optimize import minimize
from torn import column, cube

from fenics_tfeti import UnresistedMotion
from fenics_tfeti.feti import ContactRows, Prescribed, TornSolver, TornSystem
from fenics_tfeti.qp import least_norm

pytestmark = pytest.mark.once


@pytest.mark.parametrize("load", [(0, 0, -1.0), (0.3, -0.2, -2.0)])
def test_feasible_start(load):
    solver = TornSolver(column(load=load))
    system, start = DenseSystem.of(solver), solver.data.feasible
    np.testing.assert_allclose(system.G @ start, system.R.T @ system.f, atol=1e-12)
    assert np.all(start[solver.setup.constraints.inequality] >= 0)


def test_contact_forces_add_up_to_the_load():
    """Nothing else holds the upper cube up."""
    solver = TornSolver(column(load=(0, 0, -3.0)))
    constraints = solver.setup.constraints
    multipliers = solver.data.feasible[constraints.inequality]
    assert np.sum(multipliers * constraints.contacts.scale) == pytest.approx(3.0, rel=1e-10)


def test_feasible_start_of_lemma_11_1_has_no_contact_forces():
    coercive = TornSolver(column(load=(0, 0, 0)))
    assert not coercive.data.feasible[coercive.setup.constraints.inequality].any()


def test_load_that_contact_cannot_balance():
    """The upper cube stands on the lower one, and the load pulls it up."""
    with pytest.raises(UnresistedMotion, match=r"upper: translation along \(0, 0, 1\)"):
        TornSolver(column(load=(0, 0, 1.0)))


def test_load_on_a_motion_that_nothing_resists():
    free = dataclasses.replace(column(), contacts=ContactRows.none(3))
    with pytest.raises(UnresistedMotion, match=r"upper: translation along \(0, 0, -1\)"):
        TornSolver(free)


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
        forces = (solver.data.feasible * constraints.row_lengths)[constraints.inequality]
        np.testing.assert_allclose(forces, expected, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_least_norm_fulfils_its_conditions(seed):
    rng = np.random.default_rng(seed)
    C = rng.standard_normal((4, 30))
    d = C @ rng.random(30)
    x, residual = least_norm(C, d)
    np.testing.assert_allclose(C @ x, d, atol=1e-10)
    assert np.all(x >= 0) and np.linalg.norm(residual) < 1e-10
    other = minimize(
        lambda z: 0.5 * z @ z,
        np.ones(30),
        jac=lambda z: z,
        bounds=[(0, None)] * 30,
        constraints={"type": "eq", "fun": lambda z: C @ z - d, "jac": lambda z: C},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    np.testing.assert_allclose(x, other.x, atol=1e-5)


def test_least_norm_certifies_that_there_is_no_solution():
    C, d = np.array([[1.0, 2.0], [0.0, 1.0]]), np.array([-1.0, 1.0])
    _, residual = least_norm(C, d)
    assert np.all(C.T @ residual <= 1e-12) and d @ residual > 0.1
