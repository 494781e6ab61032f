"""Reactions and contact forces balance the load: each node's force counts once on any ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scenes

comm = MPI.COMM_WORLD

CASES = [
    pytest.param(scenes.two_beams, cell, id=f"beams-{cell}")
    for cell in ("quadrilateral", "triangle", "hexahedron", "tetrahedron")
] + [
    pytest.param(scene, cell, id=f"{scene.__name__}-{cell}")
    for scene in (scenes.pressed_block, scenes.block_on_ball, scenes.corner, scenes.stack_on_ground)
    for cell in ("quadrilateral", "hexahedron")
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
            nodal = -result.normal_force[:, None] * result.normal
            lever = np.cross(result.coordinates, np.pad(nodal, ((0, 0), (0, 3 - gdim))))
            force = force + comm.allreduce(nodal.sum(axis=0))
            moment = (
                moment + comm.allreduce(lever.sum(axis=0))[3 - len(problem.report.load.moment) :]
            )
    return force, moment


@pytest.mark.parametrize(("make", "cell"), CASES)
def test_supports_balance_loads_and_obstacles(make, cell):
    scene = make(comm, cell)
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
    assert comm.allgather(report.reactions) == comm.size * [report.reactions]


def test_each_condition_has_its_reaction():
    """A block squeezed by prescribed values: the top exerts all of the force, the sides nothing."""
    scene = scenes.pressed_block(comm, "hexahedron")
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


def test_contact_force_on_the_slave():
    scene = scenes.two_beams(comm, "quadrilateral")
    report = solved(scene).report
    (force,) = scene.total_forces
    np.testing.assert_allclose(
        [c.force for c in report.contacts], [(0.0, force)], atol=1e-8 * force
    )
    np.testing.assert_allclose(report.load.force, (0.0, -force), atol=1e-8 * force)
