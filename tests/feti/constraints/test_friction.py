"""Tangential rows, their scale, and the set of tangential forces."""

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
from friction_problems import (
    blocks_that_do_not_match,
    held_block,
    on_the_ground,
    pulled_strip,
    pushed_block,
)
from torn import with_prescribed

from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.friction import FrictionRows, SlipBound
from fenics_tfeti.feti.constraints.rows import build_constraints
from fenics_tfeti.qp import balls

pytestmark = pytest.mark.once

SYSTEMS = {
    "pushed": pushed_block,
    "do not match": blocks_that_do_not_match,
    "ground": on_the_ground,
    "strip": pulled_strip,
}
every_system = pytest.mark.parametrize("name", SYSTEMS)


@every_system
@pytest.mark.parametrize("weighted", [False, True])
def test_rows_are_the_tangential_jumps_of_glued_displacements(name, weighted):
    system, rng = SYSTEMS[name](), np.random.default_rng(0)
    copies = sum(s.nodes.size for s in system.subdomains)
    weights = rng.uniform(0.5, 2.0, copies) if weighted else None
    constraints, c = build_constraints(system, weights)
    nodes = np.unique(np.concatenate([s.nodes for s in system.subdomains]))
    glued = rng.standard_normal((nodes.size, system.gdim))
    held = system.prescribed
    glued[np.searchsorted(nodes, held.nodes), held.components] = held.values
    torn = np.concatenate([glued[np.searchsorted(nodes, s.nodes)] for s in system.subdomains])
    friction = constraints.friction
    jumps = constraints.matrix @ torn.ravel() - c
    slips = friction.given(friction.at_sites(jumps) / friction.scale[:, None])
    rows = system.friction.tangential_rows(system.contacts)
    expected = np.zeros(rows.size)
    values = np.sum(rows.coefficients * glued[np.searchsorted(nodes, rows.nodes)], axis=1)
    np.add.at(expected, rows.row, values)
    expected /= rows.length
    np.testing.assert_allclose(slips.ravel(), expected, atol=1e-13)


@every_system
def test_rows_are_orthonormal_but_for_the_coupled_ones(name):
    """Both tangential rows of a site have one scale and one bound."""
    system = SYSTEMS[name]()
    constraints, _ = build_constraints(system)
    B = constraints.matrix.toarray() / np.sqrt(constraints.weights)
    gram = np.eye(constraints.size)
    coupling = constraints.coupling
    gram[np.ix_(coupling.rows, coupling.rows)] = coupling.gram.toarray()
    np.testing.assert_allclose(B @ B.T, gram, atol=1e-9)
    assert np.count_nonzero(coupling.tangential) == (56 if name == "do not match" else 0)
    friction = constraints.friction
    assert friction.rows.shape == (system.friction.size, system.gdim - 1)
    assert friction.present.all()
    bound = friction.given(friction.bound.radius * friction.scale)
    np.testing.assert_allclose(bound, system.friction.bound, rtol=1e-14)


def test_slip_offset_and_prescribed_displacements_are_on_the_right_hand_side():
    system = pushed_block(slip=(0.01, -0.02))
    held = held_block().prescribed
    moved = dataclasses.replace(held, values=np.full(held.values.size, 0.5))
    for prescribed in (system.prescribed, moved):
        constraints, c = build_constraints(dataclasses.replace(system, prescribed=prescribed))
        friction = constraints.friction
        np.testing.assert_allclose(
            friction.at_sites(c) / friction.scale[:, None], np.tile([0.01, -0.02], (16, 1))
        )


def test_direction_that_prescribed_displacements_decide_has_no_row():
    system = pushed_block()
    nodes = np.concatenate([s.nodes[s.coordinates[:, 1] == 0.0] for s in system.subdomains])
    constraints, _ = build_constraints(with_prescribed(system, nodes, [1]))
    friction = constraints.friction
    assert np.count_nonzero(~friction.present[:, 1]) == 4
    assert friction.present[:, 0].all()
    feasible = friction.multiplier_set(
        constraints.inequality, np.zeros(constraints.size), friction.bound.radius
    )
    assert feasible.discs is not None
    assert feasible.discs.radius.size == 12
    assert np.count_nonzero(np.isfinite(feasible.bounds.upper)) == 4


SITES = FrictionRows(
    rows=np.array([[1, 2], [3, -1], [5, 4]]),
    contact=np.zeros(3, dtype=np.int64),
    scale=np.ones(3),
    own=np.array([2, -1, 0]),
    anywhere=True,
    curved=True,
    normal=np.array([0, -1, -1]),
    bound=SlipBound(np.array([5.0, 2.0, 0.0]), np.array([0.0, 0.5, 0.5])),
    own_bound=SlipBound(np.array([0.0, 2.0, 5.0]), np.array([0.5, 0.5, 0.0])),
)
RADIUS = SITES.bound.radius


def test_set_of_multipliers_is_shifted():
    shift = np.array([1.0, 0.5, -0.5, 3.0, 0.1, 0.2])
    feasible = SITES.multiplier_set(np.array([0]), shift, RADIUS)
    x = feasible.project(np.array([-9.0, 5.5, 8.5, -9.0, 7.0, 7.0]))
    np.testing.assert_allclose(shift + x, [0.0, 3.0, 4.0, -2.0, 0.0, 0.0], atol=1e-14)
    plane = dataclasses.replace(SITES, rows=SITES.rows[:, :1], curved=False)
    assert not plane.multiplier_set(np.array([0]), shift, RADIUS).curved


def test_state_of_sites():
    inside = np.array([9.0, 3.0, 4.0 - 1e-6, 1.9, 0.0, 0.0])
    assert balls.inside(SITES.at_sites(inside), RADIUS).tolist() == [True, True, False]
    rounded = np.array([9.0, 3.0, 4.0 - 1e-12, -2.0 + 1e-13, 0.0, 0.0])
    assert balls.inside(SITES.at_sites(rounded), RADIUS).tolist() == [False, False, False]
    at_bound = SITES.at_bound(rounded, RADIUS)
    np.testing.assert_allclose(np.linalg.norm(SITES.at_sites(at_bound), axis=1), [5.0, 2.0, 0.0])
    np.testing.assert_allclose(
        balls.directions(SITES.at_sites(at_bound)), [[0.6, 0.8], [-1.0, 0.0], [0.0, 0.0]]
    )
    assert SITES.at_bound(inside, RADIUS).tolist() == inside.tolist()


def test_values_at_sites_rows_and_what_was_given():
    x = np.arange(10.0, 16.0)
    assert SITES.at_sites(x).tolist() == [[11.0, 12.0], [13.0, 0.0], [15.0, 14.0]]
    assert SITES.given(SITES.at_sites(x)).tolist() == [[15.0, 14.0], [0.0, 0.0], [11.0, 12.0]]
    assert SITES.flat.tolist() == [1, 2, 3, 5, 4]
    assert SITES.owned(4).tolist() == [True, True, False]
    mask = SITES.on_rows(np.array([False, True, True]), 6)
    assert mask.tolist() == [False, False, False, True, True, True]
    assert SITES.within(mask).tolist() == [False, True, True]
    moved = SITES.moved(np.arange(6) + 10)
    assert moved.rows.tolist() == [[11, 12], [13, -1], [15, 14]]
    assert moved.normal.tolist() == [10, -1, -1]


def test_bounds_follow_the_normal_forces():
    """Site 2 was given first, with the contact row 0; the others have no contact row."""
    layout = DualLayout(MPI.COMM_SELF, np.array([7, 8, 9, 20, 21, 22]))
    multipliers = np.array([4.0, 9.0, 9.0, 9.0, 9.0, 9.0])
    pressing = SITES.pressing(multipliers, layout)
    assert pressing.tolist() == [0.0, 0.0, 4.0]
    assert SITES.bound.at(pressing).tolist() == [5.0, 2.0, 2.0]
    assert SITES.pressing(-multipliers, layout).tolist() == [0.0, 0.0, 0.0]
    # of an unloaded contact, beside a large force
    unloaded = np.append(1e-14, multipliers[1:])
    assert SITES.pressing(unloaded, layout).tolist() == [0.0, 0.0, 0.0]
    assert SITES.normal_numbers(layout).tolist() == [-1, -1, 7]
    first, slope = np.array([True, False, True]), np.array([0.6, 0.3, 0.3])
    given = SITES.with_bounds(SITES.normal, first, np.array([0.0, 2.0, 5.0]), slope, layout)
    assert given.bound.slope.tolist() == [0.0, 0.0, 0.6]
    assert given.bound.radius.tolist() == [5.0, 0.0, 0.0]


def test_contacts_at_one_site_add_their_bounds():
    """Both have the contact row 0, of which the first gives the force."""
    layout = DualLayout(MPI.COMM_SELF, np.array([7, 8, 9, 20, 21, 22]))
    sites = dataclasses.replace(SITES, own=np.array([2, 2]))
    normal, first = np.array([0, 0]), np.array([True, False])
    both = sites.with_bounds(normal, first, np.array([1.0, 0.5]), np.array([0.1, 0.3]), layout)
    pressing = both.pressing(np.full(6, 4.0), layout)
    assert pressing.tolist() == [0.0, 0.0, 4.0]
    np.testing.assert_allclose(both.bound.at(pressing), [0.0, 0.0, 1.5 + 0.4 * 4.0])
    np.testing.assert_allclose(both.own_bound.at(both.given(pressing)), [1.4, 1.7])


def test_rows_of_different_lengths_have_one_scale():
    """The lower block cannot move along y: half of the second rows is missing."""
    system = pushed_block()
    lower = system.subdomains[0]
    nodes = lower.nodes[lower.coordinates[:, 2] == 1.0]
    constraints, _ = build_constraints(with_prescribed(system, nodes, [1]))
    assert constraints.friction.present.all()
    lengths = np.unique(constraints.coupling.gram.diagonal().round(9))
    np.testing.assert_allclose(lengths, [0.5])
