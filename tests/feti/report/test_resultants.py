"""Reactions, contact forces and equilibrium from B'lambda, without dolfinx."""

import dataclasses

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from springs import on_springs
from torn import column, node_rows, with_fields, with_prescribed

from fenics_tfeti.feti import ContactRows, Options, TornSolver

pytestmark = pytest.mark.once

COMM = MPI.COMM_WORLD


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
    # as a vector on the slave
    forces = [c.force for c in report.contacts if contact]
    np.testing.assert_allclose(forces, contact * [[0.0, 0.0, 3.0]], atol=1e-8)


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


def test_contact_force_on_a_prescribed_component():
    """An inclined obstacle below nodes that cannot slide: the support takes the part along it."""
    system = column(contact=True, load=(0.0, 0.0, -3.0))
    upper = system.subdomains[-1]
    slave = upper.nodes[np.isclose(upper.coordinates[:, 2], 2.0)]
    rows = node_rows(slave, [0.6, 0.0, -0.8])
    system = dataclasses.replace(with_prescribed(system, slave, [0]), contacts=rows)
    slides = np.isin(system.prescribed.nodes, slave)
    condition = np.where(slides, 2, system.prescribed.nodes >= 10**9)
    report = solve(with_fields(system, "prescribed", condition=condition))
    # 0.8 / 0.6 of the weight is the force across
    np.testing.assert_allclose([c.force for c in report.contacts], [[-2.25, 0.0, 3.0]], atol=1e-8)
    across = report.reactions[1].force[0] + report.reactions[2].force[0]
    np.testing.assert_allclose(across, 2.25, rtol=1e-8)
    assert report.equilibrium < 1e-10


def test_springs_exert_what_the_load_does_not():
    system = column(contact=True, load=(0.0, 0.0, -3.0))
    *lower, upper = system.subdomains
    parts = [*lower, on_springs(upper, 3.0, 0.01, components=(2,))]
    report = solve(dataclasses.replace(system, subdomains=parts, contacts=ContactRows.none(3)))
    np.testing.assert_allclose(report.springs.force, (0.0, 0.0, 3.0), atol=1e-8)
    np.testing.assert_allclose(report.reactions[0].force, 0.0, atol=1e-8)
    assert report.equilibrium < 1e-10


CASES = [
    pytest.param(scene, cell, id=f"{scene.__name__}-{cell}")
    for scene, cell in (
        (scenes.two_beams, "triangle"),
        (scenes.two_beams, "hexahedron"),
        (scenes.pressed_block, "quadrilateral"),
        (scenes.block_on_ball, "hexahedron"),
        (scenes.corner, "hexahedron"),
        (scenes.stack_on_ground, "quadrilateral"),
    )
]


def solved(scene):
    problem = scene.problem(options={"rtol": 1e-10, "subdomain_size": 40})
    problem.solve()
    return problem


def obstacle_forces(scene, problem):
    """Return the sums of the forces and moments of obstacles, from the nodal forces."""
    gdim, force, moment = scene.mesh.geometry.dim, 0.0, 0.0
    for contact, result in zip(problem.contacts, problem.results, strict=True):
        if hasattr(contact, "obstacle"):
            nodal = -result.nodal_normal_force[:, None] * result.normal
            lever = np.cross(result.coordinates, np.pad(nodal, ((0, 0), (0, 3 - gdim))))
            force = force + COMM.allreduce(nodal.sum(axis=0))
            moment = moment + COMM.allreduce(lever.sum(axis=0))
    size = len(problem.report.load.moment)
    return force, np.broadcast_to(moment, 3)[3 - size :]


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("make", "cell"), CASES)
def test_supports_balance_loads_and_obstacles(make, cell):
    scene = make(COMM, cell)
    problem = solved(scene)
    report = problem.report
    assert len(report.reactions) == len(scene.bcs)
    force, moment = obstacle_forces(scene, problem)
    supports = sum((np.array(support.force) for support in report.reactions), np.array(force))
    size = max(np.linalg.norm(report.load.force), np.linalg.norm(force), 1.0)
    np.testing.assert_allclose(supports + report.load.force, 0.0, atol=1e-8 * size)
    turned = sum((np.array(support.moment) for support in report.reactions), np.array(moment))
    np.testing.assert_allclose(turned + report.load.moment, 0.0, atol=1e-7 * size)
    assert report.equilibrium < 1e-9
    assert np.linalg.norm(report.springs.force) == 0.0
    assert COMM.allgather(report.reactions) == COMM.size * [report.reactions]


@pytest.mark.ranks(2)
def test_each_condition_has_its_reaction():
    """A block squeezed by prescribed values: the top exerts all of the force, the sides nothing."""
    scene = scenes.pressed_block(COMM, "hexahedron")
    report = solved(scene).report
    top, *sides = report.reactions
    (force,) = scene.total_forces
    np.testing.assert_allclose(top.force, (0.0, 0.0, -force), atol=1e-8 * force)
    np.testing.assert_allclose(top.moment, (-0.5 * force, 0.5 * force, 0.0), atol=1e-8 * force)
    for side in sides:
        np.testing.assert_allclose(side.force, 0.0, atol=1e-8 * force)
    np.testing.assert_allclose(
        [c.force for c in report.contacts], [(0.0, 0.0, force)], atol=1e-8 * force
    )
