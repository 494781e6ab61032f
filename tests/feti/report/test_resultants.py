"""Reactions, contact forces and equilibrium from B'lambda, without dolfinx."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from torn import column

from fenics_tfeti.feti import ContactRows, Options, TornSolver


def solve(system):
    return TornSolver(system, Options(rtol=1e-9)).solve().report


@pytest.mark.parametrize("contact", [True, False])
def test_the_support_exerts_what_the_load_does_not(contact):
    # its line of action is x = y = 0.5
    report = solve(column(contact=contact, load=(0.1, 0.2, -3.0)))
    (support,) = report.reactions
    np.testing.assert_allclose(report.load.force, (0.1, 0.2, -3.0), rtol=1e-12)
    np.testing.assert_allclose(support.force, (-0.1, -0.2, 3.0), rtol=1e-8)
    total = np.add(support.moment, report.load.moment)
    np.testing.assert_allclose(total, 0.0, atol=1e-8)
    assert report.equilibrium < 1e-10


def test_conditions_are_told_apart():
    system = column(load=(0.1, 0.2, -3.0))
    top = system.prescribed.nodes >= 10**9
    given = dataclasses.replace(system.prescribed, condition=np.where(top, 2, 0))
    lower, none, upper = solve(dataclasses.replace(system, prescribed=given)).reactions
    np.testing.assert_allclose(lower.force, (0.0, 0.0, 3.0), atol=1e-8)
    np.testing.assert_allclose(upper.force, (-0.1, -0.2, 0.0), atol=1e-8)
    assert none.force == [0.0, 0.0, 0.0]
    assert none.name == "Dirichlet condition 1"


def test_the_last_condition_counts():
    system = column(load=(0.1, 0.2, -3.0))
    once = system.prescribed
    twice = dataclasses.replace(
        once,
        **{name: np.tile(getattr(once, name), 2) for name in ("nodes", "components", "values")},
        condition=np.repeat([0, 1], once.nodes.size),
    )
    system = dataclasses.replace(system, prescribed=twice, condition_names=["one", "other"])
    first, last = solve(system).reactions
    assert first.force == [0.0, 0.0, 0.0]
    assert (first.name, last.name) == ("one", "other")
    np.testing.assert_allclose(last.force, (-0.1, -0.2, 3.0), rtol=1e-8)


def test_contact_forces_are_vectors_on_the_slave():
    report = solve(column(load=(0.0, 0.0, -3.0)))
    np.testing.assert_allclose([c.force for c in report.contacts], [[0.0, 0.0, 3.0]], atol=1e-8)


def test_contact_force_on_a_prescribed_component():
    """An inclined obstacle below nodes that cannot slide: the support takes the part along it."""
    system = column(contact=True, load=(0.0, 0.0, -3.0))
    upper, top = system.subdomains[-1], system.prescribed.nodes >= 10**9
    slave = upper.nodes[np.isclose(upper.coordinates[:, 2], 2.0)]
    normal = np.tile([0.6, 0.0, -0.8], (slave.size, 1))
    nothing = np.zeros(slave.size)
    held = dataclasses.replace(
        system.prescribed,
        nodes=np.concatenate([system.prescribed.nodes, slave]),
        components=np.concatenate([system.prescribed.components, 0 * slave]),
        values=np.concatenate([system.prescribed.values, nothing]),
        condition=np.concatenate([np.where(top, 1, 0), 0 * slave + 2]),
    )
    rows = ContactRows.node_to_node(slave, 0 * slave - 1, normal, nothing, 0 * slave)
    report = solve(dataclasses.replace(system, prescribed=held, contacts=rows))
    # 0.8 / 0.6 of the weight is the force across
    np.testing.assert_allclose([c.force for c in report.contacts], [[-2.25, 0.0, 3.0]], atol=1e-8)
    across = report.reactions[1].force[0] + report.reactions[2].force[0]
    np.testing.assert_allclose(across, 2.25, rtol=1e-8)
    assert report.equilibrium < 1e-10


def test_springs_exert_what_the_load_does_not():
    system = column(contact=True, load=(0.0, 0.0, -3.0))
    *lower, upper = system.subdomains
    K = upper.stiffness.copy()
    vertical = np.arange(2, K.shape[0], 3)
    K[vertical, vertical] += 0.01
    system = dataclasses.replace(
        system,
        subdomains=[*lower, dataclasses.replace(upper, stiffness=K.tocsr())],
        contacts=ContactRows.none(3),
    )
    report = solve(system)
    np.testing.assert_allclose(report.springs.force, (0.0, 0.0, 3.0), atol=1e-8)
    np.testing.assert_allclose(report.reactions[0].force, 0.0, atol=1e-8)
    assert report.equilibrium < 1e-10
