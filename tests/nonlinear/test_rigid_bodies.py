"""Rigid bodies that forces move on bodies with finite strains."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scenes import GROUND, LOADED, MASTER, SLAVE, Scene, at

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    Coulomb,
    NonlinearContactProblem,
    Plane,
    RigidBody,
    RigidObstacle,
    Sphere,
)
from fenics_tfeti.models import neo_hookean

COMM = MPI.COMM_WORLD
E = 1e6


def rubber(contacts, width=1.0, n=4, dim=2):
    """Return the problem of a soft block, clamped at its bottom."""
    marks = [(LOADED, at(dim - 1, 1.0)), (GROUND, at(dim - 1, 0.0))]
    box = ((0.0,) * dim, (width,) + (1.0,) * (dim - 1), (round(n * width),) + (n,) * (dim - 1))
    scene = Scene.of_boxes(COMM, {2: "quadrilateral", 3: "hexahedron"}[dim], [box], marks)
    scene.fix(GROUND)
    u = fem.Function(scene.V)
    energy = neo_hookean(E, 0.3)(u) * ufl.dx(metadata={"quadrature_degree": 2})
    F = ufl.derivative(energy, u, ufl.TestFunction(scene.V))
    listed = [RigidObstacle(scene.facet_tags, LOADED, **contact) for contact in contacts]
    return NonlinearContactProblem(F, u, bcs=scene.bcs, contacts=listed)


class Value:
    """What a dolfinx Constant is here: a value that the next solve reads."""

    value: Any = 0.0


def lid(**more):
    return RigidBody((0.5, 1.0), name="lid", **more)


TOP = Plane((0.0, 1.0), (0.0, -1.0))


def test_force_and_prescribed_motion_are_inverse():
    """A lid that prescribed motions press and turn, and the loads that these take."""
    pushed = lid(translation=(0.0, -0.05), rotation=-0.05)
    problem = rubber([{"obstacle": TOP, "rigid_body": pushed}], n=2)
    problem.solve()
    first, (held,) = problem.u.x.array.copy(), problem.rigid_bodies
    assert held.translation == pytest.approx([0.0, -0.05])
    assert held.rotation == pytest.approx([-0.05])
    assert held.reaction[1] < -0.05 * E

    force, moment = (
        fem.Constant(problem.space.mesh, (0.0, 0.0)),
        fem.Constant(problem.space.mesh, 0.0),
    )
    loaded = lid(force=force, moment=moment, translation=(0.0, None))
    problem = rubber([{"obstacle": TOP, "rigid_body": loaded}], n=2)

    def set_load(t):
        force.value[:] = 0.0, t * held.reaction[1]
        moment.value = t * held.reaction_moment[0]

    for _ in problem.steps(set_load, 0.0, 1.0, first=0.5):
        pass
    (free,) = problem.rigid_bodies
    assert free.translation[1] == pytest.approx(-0.05, rel=1e-4)
    assert free.rotation[0] == pytest.approx(-0.05, rel=1e-4)
    assert np.abs(problem.u.x.array - first).max(initial=0.0) <= 1e-4 * 0.05


def test_steps_are_cut_where_a_body_would_turn_too_far():
    turned = lid(translation=(0.0, 0.0), rotation=0.45)
    problem = rubber([{"obstacle": Plane((0.0, 5.0), (0.0, -1.0)), "rigid_body": turned}], n=2)
    problem.solve()
    lengths = [step.length for step in problem.report.newton]
    assert lengths == pytest.approx([0.3 / 0.45, 1.0], rel=1e-6)


@pytest.mark.parametrize("friction", [None, Coulomb(0.05)])
def test_plate_tilts_about_two_axes(friction):
    """Prescribed motions and the loads that these take; the rubber slides along the plate."""
    plane = Plane((0.5, 0.5, 1.0), (0.0, 0.0, -1.0))

    def solved(**more):
        plate = RigidBody((0.5, 0.5, 1.0), name="plate", **more)
        problem = rubber(
            [{"obstacle": plane, "rigid_body": plate, "friction": friction}], n=2, dim=3
        )
        problem.solve()
        assert len(problem.report.newton) <= 8
        return problem.rigid_bodies["plate"]

    # a motion of which a load keeps the direction, but for the moment about the vertical
    down, turned = -0.16, [0.1, -0.06, 0.0]
    held = solved(translation=(0.0, 0.0, down), rotation=turned)
    force, moment = (0.0, 0.0, held.reaction[2]), (*held.reaction_moment[:2], 0.0)
    free = solved(
        force=force, moment=moment, translation=(0.0, 0.0, None), rotation=(None, None, 0.0)
    )
    assert free.translation[2] == pytest.approx(down, rel=1e-4)
    # about the vertical it has the sum of steps, which are about other axes each
    assert free.rotation[:2] == pytest.approx(turned[:2], rel=1e-4)


def test_wheel_rolls_on_rubber():
    """A pressed wheel that a moment turns sticks to the rubber: it rolls by nearly R times t."""
    radius, turns = 0.5, Value()
    wheel = RigidBody((0.7, 1.5), force=(0.0, -0.02 * E), rotation=turns, name="wheel")
    tyre = Sphere((0.7, 1.5), radius)
    problem = rubber(
        [{"obstacle": tyre, "rigid_body": wheel, "friction": Coulomb(1.0)}], width=2.0, n=6
    )

    def set_load(t):
        turns.value = -t

    for _ in problem.steps(set_load, 0.0, 0.5, first=0.125):
        pass
    (result,) = problem.rigid_bodies
    assert result.rotation[0] == pytest.approx(-0.5)
    # the rubber under the wheel is compressed: rolling is shorter by a few per cent
    assert 0.9 * 0.25 < result.translation[0] < 1.05 * 0.25
    # nothing pushes it: the contact's tangential force is zero
    assert abs(result.force[0]) < 1e-6 * E
    assert result.force[1] == pytest.approx(0.02 * E, rel=1e-5)


def test_places_of_bodies_on_another_mesh():
    """A loaded lid starts where it is on the coarser mesh; on the same mesh it is at its end."""
    moved = lid(translation=(0.0, None), force=(0.0, -0.05 * E), rotation=0.02)
    coarse, again, finer = (
        rubber([{"obstacle": TOP, "rigid_body": moved}], n=n) for n in (2, 2, 4)
    )
    coarse.solve()
    again.solve(coarse=coarse)
    assert len(again.report.newton) == 1
    finer.solve(coarse=coarse)
    assert len(finer.report.newton) < len(coarse.report.newton)
    assert finer.rigid_bodies[0].force[1] == pytest.approx(0.05 * E, rel=1e-6)


def test_restored_problem_goes_on(tmp_path):
    """A checkpoint has the places of bodies: a new problem ends where the first one does."""

    def posed():
        force = Value()
        force.value = (0.0, 0.0)
        body = lid(force=force, translation=(0.0, None), rotation=0.0)
        return force, rubber([{"obstacle": TOP, "rigid_body": body}])

    force, problem = posed()
    for share in (0.5, 1.0):
        force.value = (0.0, -0.1 * share * E)
        problem.solve()
        problem.advance()
        if share == 0.5:
            problem.save(tmp_path / "half.npz")
    again_force, again = posed()
    assert again.restore(tmp_path / "half.npz") == 1
    again_force.value = (0.0, -0.1 * E)
    again.solve()
    (first,), (second,) = problem.rigid_bodies, again.rigid_bodies
    assert second.translation == pytest.approx(first.translation, rel=1e-5)
    assert len(again.report.newton) <= len(problem.report.newton)


@pytest.mark.ranks(2)
def test_cells_of_the_mesh():
    """A foot that turns on rubber is a much stiffer one: displacements and pressures."""
    found = []
    for stiffer, rigid in ((1.0, {2: RigidBody((0.45, 1.4), name="foot")}), (1e5, {})):
        marks = [
            (GROUND, at(1, 0.0)),
            (SLAVE, at(1, 1.0), 1),
            (MASTER, at(1, 1.0), 2),
            (LOADED, at(1, 1.4)),
        ]
        parts = [((0.0, 0.0), (1.0, 1.0), (3, 3)), ((0.2, 1.0), (0.7, 1.4), (2, 1))]
        scene = Scene.of_boxes(COMM, "quadrilateral", parts, marks)
        scene.fix(GROUND)
        u, up = fem.Function(scene.V), scene.constant((0.005 * E, -0.02 * E))
        energy = neo_hookean(E, 0.3)(u)
        work = ufl.inner(up, u) * (1 + ufl.SpatialCoordinate(scene.mesh)[0]) * scene.ds(LOADED)
        total = energy * scene.dx(1) + stiffer * energy * scene.dx(2) - work
        problem = NonlinearContactProblem(
            ufl.derivative(total, u, ufl.TestFunction(scene.V)),
            u,
            bcs=scene.bcs,
            contacts=[ContactPair(scene.facet_tags, SLAVE, MASTER, friction=Coulomb(0.5))],
            cell_tags=scene.cell_tags,
            rigid_bodies=rigid,
            options={"newton_rtol": 1e-7},
        )
        problem.solve()
        found.append((u.x.array.copy(), problem.results[0].gather().pressure))
        if rigid:
            assert problem.rigid_bodies["foot"].rotation[0] < -0.03
    for values, stiff in zip(*found, strict=True):
        assert np.abs(values - stiff).max(initial=0.0) <= 1e-4 * np.abs(stiff).max(initial=0.0)


def test_springs_are_no_tangents():
    """Two lids over one surface, on springs that resist translations alone, overlap the block."""
    stiffness = np.array([0.05, 0.13]) * E
    lids = [
        {
            "obstacle": Plane((0.0, height), (0.0, -1.0)),
            "rigid_body": RigidBody(
                (0.5, height),
                name=f"lid at {height}",
                translation=(0.0, None),
                rotation=0.0,
                spring=np.diag([k, k, 0.0]),
            ),
        }
        for k, height in zip(stiffness, (0.95, 0.97), strict=True)
    ]
    problem = rubber(lids, width=2.0, n=2)
    problem.solve()
    raised = np.array([body.translation[1] for body in problem.rigid_bodies])
    forces = [-result.force[1] for result in problem.results]
    assert forces == pytest.approx(stiffness * raised, rel=1e-5)
    # both lie on the block
    assert 0.95 + raised[0] == pytest.approx(0.97 + raised[1], rel=1e-6)
    assert len(problem.report.newton) <= 4
    assert max(step.products for step in problem.report.newton) <= 30
