"""Rigid motions of bodies: what resists them, and their names."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
from dense import DenseSystem
from torn import column, cube

from fenics_tfeti.feti import ContactRows, Prescribed, TornSolver
from fenics_tfeti.feti.coarse.body_motions import describe_body_motions

pytestmark = pytest.mark.once

SOLVER = TornSolver(column())
SYSTEM = DenseSystem.of(SOLVER)
BODIES = SOLVER.setup.projector.coarse_space.bodies
KERNELS = SOLVER.setup.local.kernels
CONSTRAINTS = SOLVER.setup.constraints


def test_motions_of_a_body_have_a_mean_square_of_one_and_keep_it_glued():
    motions = SYSTEM.R @ BODIES.basis.toarray()
    rows = SYSTEM.B / np.linalg.norm(SYSTEM.B, axis=1)[:, None]
    np.testing.assert_allclose(BODIES.moved.toarray(), rows @ motions, atol=1e-11)
    assert motions.shape[1] == 12
    nodes = [sum(s.nodes.size for s in SOLVER.system.subdomains if s.body == b) for b in (0, 1)]
    np.testing.assert_allclose(motions.T @ motions, np.diag(np.repeat(nodes, 6)), atol=1e-11)
    np.testing.assert_allclose(SYSTEM.K @ motions, 0.0, atol=1e-13)
    nodes = np.concatenate([s.nodes for s in SOLVER.system.subdomains])
    first = {node: i for i, node in reversed(list(enumerate(nodes)))}
    copies = [first[node] for node in nodes]
    by_node = motions.reshape(nodes.size, 3, 12)
    np.testing.assert_allclose(by_node, by_node[copies], atol=1e-13)


def gram(rows: np.ndarray) -> np.ndarray:
    """Return the Gram matrix by which some rows resist the motions."""
    return (BODIES.moved[rows].T @ BODIES.moved[rows]).toarray()


def test_equality_rows_hold_the_lower_body_but_not_the_upper_one():
    held = gram(CONSTRAINTS.equality)
    lower, upper = np.linalg.eigvalsh(held[:6, :6]), np.linalg.eigvalsh(held[6:, 6:])
    assert lower[0] > 0.01
    assert np.count_nonzero(upper > 0.01) == 3 and np.abs(upper[:3]).max() < 1e-12


@pytest.mark.parametrize(("axes", "left"), [((0, 1, 2), 0), ((2,), 3)])
def test_elastic_support_resists(axes, left):
    """A cube on springs along some axes; along z alone it may slide and turn about z."""
    block = cube(2)
    springs = np.where(np.isin(np.arange(block.size) % 3, axes), 0.1, 0.0)
    held = dataclasses.replace(block, stiffness=(block.stiffness + sp.diags(springs)).tocsr())
    system = dataclasses.replace(
        column(), subdomains=[held], contacts=ContactRows.none(3), prescribed=Prescribed()
    )
    bodies = TornSolver(system).setup.projector.coarse_space.bodies
    resistance = np.linalg.svd(bodies.supports, compute_uv=False)
    assert np.count_nonzero(resistance < 1e-12) == left
    assert np.count_nonzero(resistance > 0.1) == 6 - left


@pytest.mark.parametrize(("moving", "names", "either_way"), [
    ([1.0, 0.0], ["lower: translation along (0, 0, 1)"], False),
    ([0.0, -2.0], ["upper: translation along (0, 0, -1)"], False),
    ([0.0, -2.0], ["upper: translation along (0, 0, 1)"], True),
    ([1.0, 1.0], [f"{b}: translation along (0, 0, 1)" for b in ("lower", "upper")], False),
    ([1.0, 1e-8], ["lower: translation along (0, 0, 1)"], False),
])  # fmt: skip
def test_motion_is_named_by_body(moving, names, either_way):
    parts = SOLVER.system.subdomains
    up = np.concatenate([np.tile([0.0, 0.0, moving[s.body]], s.nodes.size) for s in parts])
    motion = SYSTEM.R.T @ up
    (found,) = describe_body_motions(
        SOLVER.system, KERNELS, sp.csr_matrix(motion), either_way=either_way
    )
    assert found == "; ".join(names)


def test_a_rotation_is_named_by_the_axis_next_to_the_whole_body():
    """The subdomain that moves farthest is farther from the axis than it is wide."""
    lower = [s for s in SOLVER.system.subdomains if s.body == 0]
    x = np.concatenate([s.coordinates for s in lower])
    pole = np.append(x.mean(axis=0)[:2], x[:, 2].min() - 0.4 * np.ptp(x[:, 2]))
    turned = np.concatenate(
        [
            (np.cross([0.0, 1.0, 0.0], s.coordinates - pole) * (s.body == 0)).ravel()
            for s in SOLVER.system.subdomains
        ]
    )
    (words,) = describe_body_motions(SOLVER.system, KERNELS, sp.csr_matrix(SYSTEM.R.T @ turned))
    assert words.startswith("lower: rotation about the axis (0, 1, 0) through (")


def test_of_a_motion_of_many_bodies_three_are_named_and_the_others_counted():
    cubes = [dataclasses.replace(cube(2), body=body) for body in range(30)]
    system = dataclasses.replace(
        column(), subdomains=cubes, contacts=ContactRows.none(3), prescribed=Prescribed()
    )
    up = [np.tile([0.0, 0.0, 1.0], s.nodes.size)[:, None] for s in cubes]
    (words,) = describe_body_motions(system, up, sp.csr_matrix(np.ones((1, 30))))
    assert words.count("translation along (0, 0, 1)") == 3
    assert words.endswith("; and 27 other bodies")
