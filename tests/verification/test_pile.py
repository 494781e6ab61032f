"""Three loose cylinders in a trough: the contact forces by the statics of rigid discs."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

from mpi4py import MPI

import numpy as np
import pytest
from scenes import elasticity, vector_space

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import read_msh

pytest.importorskip("gmsh")

SCRIPT = Path(__file__).parents[2] / "meshes" / "pile_of_cylinders.py"
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
    spec = importlib.util.spec_from_file_location("pile_mesh", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with TemporaryDirectory() as folder:
        module.pile_of_cylinders(Path(folder, "pile.msh"), dim, elements)
        return read_msh(Path(folder, "pile.msh"), MPI.COMM_SELF, gdim=dim)


def solved(dim, elements, young=YOUNG):
    """Return the solved problem."""
    bodies = meshed(dim, elements)
    mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names
    V = vector_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    weight = fem.Constant(mesh, SPECIFIC_WEIGHT)
    x_axis, up = np.eye(dim)[:2]

    def radial(x):
        return np.array([x[0], x[1] - 2.6 * RADIUS, 0.0 * x[2]])[:dim]

    contacts = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        wall = Plane(-2.2 * sign * RADIUS * x_axis, sign * x_axis)
        contacts += [
            ContactPair(
                facet_tags,
                tags[f"top {side}"],
                tags[f"{side} top"],
                name=f"top {side}",
                normal=radial,
            ),
            RigidObstacle(
                facet_tags, tags[f"{side} floor"], Plane(0 * up, up), name=f"{side} floor"
            ),
            RigidObstacle(facet_tags, tags[f"{side} wall"], wall, name=f"{side} wall"),
        ]
    problem = ContactProblem(
        elasticity(u, v, fem.Constant(mesh, young)),
        -weight * v[1] * ufl.dx,
        contacts=contacts,
        cell_tags=bodies.cell_tags,
        options={"rtol": 1e-8},
    )
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
