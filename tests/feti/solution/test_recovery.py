from __future__ import annotations

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from friction_problems import pushed_block
from sparse_rows import distributed
from torn import column, cube, fixed_nodes, node_rows

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.solution.recovery import balance_multipliers


def two_blocks(overlap: float):
    """A block held at a side, and a loose one beside it, both on the ground.

    The second one reaches into the first by `overlap`, and may slide away.
    """
    first, second = cube(2), cube(2, (1, 0, 0), body=1, first=10**9)
    ground = np.concatenate([s.nodes[s.coordinates[:, 2] == 0] for s in (first, second)])
    wall, side = (first.nodes[first.coordinates[:, 0] == x] for x in (0, 1))
    below = node_rows(ground, [0, 0, -1.0])
    between = node_rows(side, [1.0, 0, 0], side + 10**9, gap=-overlap, contact=1)
    return dataclasses.replace(
        column(),
        subdomains=[first, second],
        contacts=ContactRows.concatenate([below, between]),
        prescribed=fixed_nodes(wall, [0, 1]),
        body_names=("a", "b"),
    )


@pytest.mark.parametrize("overlap", [0.25, -0.25])
def test_loose_body_gives_way_by_the_smallest_motion(overlap):
    """No force acts, so the loose block moves aside rigidly if it has to, and only then."""
    solution = TornSolver(two_blocks(overlap), Options(rtol=1e-8)).solve()
    u = solution.displacements[1].reshape(-1, 3)
    np.testing.assert_allclose(u, np.tile([max(overlap, 0.0), 0, 0], (len(u), 1)), atol=1e-9)


@pytest.mark.ranks(1, 2, 3)
def test_loads_that_copies_share_out_are_at_rest_on_any_ranks():
    """Copies of a node have loads that cancel; that of the first one's rank is zero."""
    corners = (0, 0, 0), (1, 0, 0), (0, 1, 0)
    cubes = [
        dataclasses.replace(s, stiffness=factor * s.stiffness)
        for s, factor in zip(map(cube, (2, 2, 2), corners), (1.0, 7.0, 0.3), strict=True)
    ]
    shared = np.intersect1d(np.intersect1d(cubes[0].nodes, cubes[1].nodes), cubes[2].nodes)[0]
    for block, load in zip(cubes, (0.0, 0.1, -0.1), strict=True):
        block.load[3 * np.flatnonzero(block.nodes == shared)] = load
    bottom = np.unique(np.concatenate([s.nodes[s.coordinates[:, 2] == 1] for s in cubes]))
    fixed = fixed_nodes(bottom, [0, 1, 2])
    system = distributed(TornSystem(cubes, fixed, ContactRows.none(3), 3), MPI.COMM_WORLD)
    solution = TornSolver(system).solve()
    assert solution.report.products["total"] == 0
    assert not any(u.any() for u in solution.displacements)


def test_forces_at_their_bound_turn_to_balance_the_load():
    """All sites slip, in directions that fan out: G lambda = e is not linear in these."""
    solver = TornSolver(pushed_block(load=(0.16 * 0.99, 0.0, -1.0), bound=0.01))
    coarse_space, radius = solver.setup.projector.coarse_space, solver.data.radius
    friction, start = solver.setup.constraints.friction, solver.data.feasible.copy()
    angle = 0.2 * (-1.0) ** np.arange(friction.size)
    start[friction.rows] = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if friction.at_sites(solver.data.feasible)[:, 0].sum() < 0.0:
        start[friction.rows[:, 0]] *= -1.0
    multipliers, projector = balance_multipliers(coarse_space, solver.data.e, start, radius)
    missing = solver.data.e - coarse_space.restrict(multipliers)
    assert np.linalg.norm(missing) <= 1e-12 * np.linalg.norm(solver.data.e)
    force = np.linalg.norm(friction.at_sites(multipliers), axis=1)
    np.testing.assert_allclose(force, radius, rtol=1e-12)
    assert not projector.face.sticking.any()
    assert projector.free.shape[1] == 0
