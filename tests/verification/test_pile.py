"""Three loose cylinders in a trough: the contact forces by the statics of rigid discs."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from mesh_arrays import of_script
from scenes import Scene, plane

import ufl
from dolfinx import fem

from fenics_tfeti import Plane

pytestmark = pytest.mark.once

RADIUS, SPECIFIC_WEIGHT, YOUNG = 0.25, 9810.0, 0.5e9
CIRCLE = SPECIFIC_WEIGHT * np.pi * RADIUS**2  # [N/m]
# contact -> its body and the force on it, in units of a disc's weight
STATICS = {
    "top left": (3 / 8, 1 / 2),
    "top right": (-3 / 8, 1 / 2),
    "left floor": (0, 3 / 2),
    "right floor": (0, 3 / 2),
    "left wall": (3 / 8, 0),
    "right wall": (-3 / 8, 0),
}


@lru_cache(maxsize=None)
def meshed(dim, elements):
    """Return the bodies, meshed by the script of the demo."""
    return of_script("pile_of_cylinders", dim, dim, elements)


@lru_cache(maxsize=None)
def solved(dim, elements, young=YOUNG):
    """Return the solved problem."""
    bodies = meshed(dim, elements)
    scene, tags = Scene.of(bodies, young=young), bodies.names
    scene.L = -scene.constant(SPECIFIC_WEIGHT) * scene.v[1] * ufl.dx
    x_axis = np.eye(dim)[0]

    def radial(x):
        return np.array([x[0], x[1] - 2.6 * RADIUS, 0.0 * x[2]])[:dim]

    for side, sign in (("left", 1.0), ("right", -1.0)):
        name = f"top {side}"
        scene.add_pair(tags[name], tags[f"{side} top"], name=name, normal=radial)
        name = f"{side} floor"
        scene.add_obstacle(tags[name], plane(1, dim), name=name)
        name, wall = f"{side} wall", Plane(-2.2 * sign * RADIUS * x_axis, sign * x_axis)
        scene.add_obstacle(tags[name], wall, name=name)
    problem = scene.problem(options={"rtol": 1e-8})
    problem.solve()
    return problem


def resultants(problem):
    """Return the force on the slave of each contact, by name."""
    return {c.name: -c.normal_force @ c.normal for c in problem.results}


def meshed_weight(dim, elements, body):
    """Return the weight of a body's polygon."""
    bodies = meshed(dim, elements)
    dx = ufl.Measure("dx", domain=bodies.mesh, subdomain_data=bodies.cell_tags)
    one = fem.Constant(bodies.mesh, SPECIFIC_WEIGHT)
    return fem.assemble_scalar(fem.form(one * dx(bodies.names[body])))


def errors(problem, unit):
    """Return the error of each force relative to statics with discs of the weight `unit`."""
    found = resultants(problem)
    exact = {
        name: unit * np.pad(force, (0, problem.space.mesh.geometry.dim - 2))
        for name, force in STATICS.items()
    }
    return np.array(
        [np.linalg.norm(found[n] - exact[n]) / np.linalg.norm(exact[n]) for n in STATICS]
    )


def assert_equilibrium(problem, dim, elements):
    """Each body is in equilibrium, and contact of round bodies has no moment about the axis."""
    forces = resultants(problem)
    for body in ("left", "right", "top"):
        total = sum(force for name, force in forces.items() if name.startswith(body))
        if body != "top":
            total = total - forces[f"top {body}"]
        total[1] -= meshed_weight(dim, elements, body)
        np.testing.assert_allclose(total, 0.0, atol=1e-8 * CIRCLE, err_msg=body)
    # all normals of the upper body meet in its axis
    for contact in problem.results:
        if contact.name.startswith("top"):
            arm = contact.coordinates[:, :2] - [0.0, 2.6 * RADIUS]
            n = contact.normal
            moment = contact.normal_force @ (arm[:, 0] * n[:, 1] - arm[:, 1] * n[:, 0])
            assert abs(moment) <= 1e-12 * CIRCLE * RADIUS


def test_forces_by_statics():
    """The weight of the polygons converges with the square of the element size."""
    problems = [solved(2, elements) for elements in (4, 8, 16)]
    limits = [errors(problem, CIRCLE) for problem in problems]
    assert np.all(limits[1] <= 0.5 * limits[0])
    assert np.all(limits[2] <= 0.5 * limits[1])
    assert limits[2].max() <= 1e-3
    for problem, elements in zip(problems[1:], (8, 16), strict=True):
        assert_equilibrium(problem, 2, elements)
        (motion,) = problem.report.free_motions
        assert motion.endswith("rotation through (0, 0.65)")
    # places of contact are not a single node, and not the whole tagged arc
    for contact in problems[2].results:
        assert 3 <= np.count_nonzero(contact.active) <= contact.active.size / 2


def test_stiffer_bodies_are_closer_to_rigid_ones():
    """With the weight of the polygon, what is left is the displacement of the contacts."""
    weight = meshed_weight(2, 16, "top")
    soft, stiff = (errors(solved(2, 16, young), weight).max() for young in (YOUNG / 10, YOUNG))
    assert soft <= 1e-3
    assert stiff <= 0.5 * soft


@pytest.mark.heavy
def test_three_dimensions():
    """The cylinders are free to slide along their axes, and the upper one to spin."""
    problem = solved(3, 4)
    assert errors(problem, meshed_weight(3, 4, "top")).max() <= 2e-3
    assert_equilibrium(problem, 3, 4)
    assert len(problem.report.free_motions) == 4
