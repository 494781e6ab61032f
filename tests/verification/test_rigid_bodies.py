"""Rigid bodies under given forces on a half space, by formulas.

The half space is axisymmetric, with a radius and a depth of 200 a. It is held there, where a point
force F displaces a surface by F / (pi E* 200 a): that is missing of the approach. The grid shrinks
towards the radius a, to less than a / 64 at 16 divisions of it.
"""

from __future__ import annotations

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import POISSON, Scene, axisymmetric_strain, elasticity

import ufl

from fenics_tfeti import RigidBody, Sphere

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
    scene.add_obstacle(tags["top"], shape, rigid_body=body)
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
