"""Rigid bodies under given forces on a half space, by formulas.

The half space is axisymmetric, with a radius and a depth of 200 a. It is held there, where a point
force F displaces a surface by F / (pi E* 200 a): that is missing of the approach. The grid shrinks
towards the radius a, to less than a / 64 at 16 divisions of it.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import LOADED, POISSON, Scene, at, axisymmetric_strain, elasticity

import ufl

from fenics_tfeti import Plane, RigidBody, Sphere

RADIUS, YOUNG = 0.01, 2e9
REDUCED = YOUNG / (1.0 - POISSON**2)


def pressed(shape, force: float, divisions: int = 16):
    """Return the solved problem of a body with a shape, pressed down along the axis."""
    bodies = of_script("half_space", 2, "quadrilateral", divisions, RADIUS)
    scene, tags = Scene.of(bodies, young=YOUNG), bodies.names
    scene.fix(tags["far"])
    scene.fix(tags["symmetry_x"], 0)
    circumference = 2.0 * ufl.pi * ufl.SpatialCoordinate(scene.mesh)[0]
    young = scene.young * circumference
    scene.a = elasticity(scene.u, scene.v, young, strain=axisymmetric_strain)
    body = RigidBody((0.0, 0.0), force=(0.0, -force), translation=(0.0, None), rotation=0.0)
    scene.add_obstacle(tags["top"], shape, body=body)
    problem = scene.problem(
        cell_tags=None,
        measure_weight=circumference,
        options={"rtol": 1e-6, "preconditioner": "lumped"},
    )
    problem.solve()
    return problem


def missing(force: float) -> float:
    """Return the displacement of a half space at the distance where it is held here."""
    return force / (np.pi * REDUCED * 200.0 * RADIUS)


def flat(x):
    below = x[0] < RADIUS * (1.0 + 1e-6)
    down = np.zeros((2, below.size))
    down[1] = -1.0
    return np.where(below, 0.0, np.inf), down


def test_flat_punch():
    """F = 2 a E* d, and the pressure F / (2 pi a sqrt(a^2 - r^2)) up to 3/4 a."""
    approach = 1e-4
    force = 2.0 * RADIUS * REDUCED * approach
    problem = pressed(flat, force)
    (body,) = problem.rigid_bodies
    assert body.translation[1] == pytest.approx(missing(force) - approach, rel=0.01)
    contact = problem.results[0]
    r = contact.coordinates[:, 0] / RADIUS
    inner = r < 0.75
    exact = force / (2.0 * np.pi * RADIUS**2 * np.sqrt(1.0 - r[inner] ** 2))
    assert contact.pressure[inner] == pytest.approx(exact, rel=0.01)


def test_ball():
    """Hertz: a^3 = 3 F R / (4 E*), d = a^2 / R."""
    ball = 100.0 * RADIUS
    force = 4.0 * REDUCED * RADIUS**3 / (3.0 * ball)
    problem = pressed(Sphere((0.0, ball), ball), force)
    (body,) = problem.rigid_bodies
    assert body.translation[1] == pytest.approx(missing(force) - RADIUS**2 / ball, rel=0.005)
    assert body.force[1] == pytest.approx(force, rel=1e-6)


def test_against_a_stiff_elastic_body():
    """A punch of rubber's shape but 1e6 times as stiff gives the same displacement of the block."""
    cell, n = "quadrilateral", 8
    top, foot, seat, ground = LOADED, 20, 21, 22
    marks = [
        (ground, at(1, 0.0), 1),
        (seat, at(1, 1.0), 1),
        (foot, at(1, 1.0), 2),
        (top, lambda x: np.isclose(x[1], 2.0) & (x[0] <= 0.5 + 1e-9), 2),
    ]
    parts = [((0.0, 0.0), (1.0, 1.0), (n, n)), ((0.0, 1.0), (1.0, 2.0), (n, n))]
    pressure = 1e-3 * YOUNG
    scene = Scene.of_boxes(MPI.COMM_WORLD, cell, parts, marks, young={1: YOUNG, 2: 1e6 * YOUNG})
    scene.fix(ground)
    # the upper block does not slide
    scene.fix(foot, 0)
    scene.add_load(top, (0.0, -pressure))
    scene.add_pair(seat, foot)
    elastic = scene.problem(options={"rtol": 1e-10})
    elastic.solve()

    alone = Scene.of_boxes(MPI.COMM_WORLD, cell, parts[:1], marks[:2], young=YOUNG)
    alone.cell_tags = None
    alone.fix(ground)
    body = RigidBody((0.25, 2.0), force=(0.0, -0.5 * pressure), translation=(0.0, None))
    alone.add_obstacle(seat, Plane((0.0, 1.0), (0.0, -1.0)), body=body)
    rigid = alone.problem(options={"rtol": 1e-10})
    rigid.solve()

    first, second = (problem.results[0].gather().normal_force for problem in (elastic, rigid))
    assert 0 < np.count_nonzero(second) < second.size
    assert np.sort(first) == pytest.approx(np.sort(second), rel=1e-4, abs=1e-5 * second.max())
