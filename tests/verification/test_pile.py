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
every_contact = pytest.mark.parametrize("name", STATICS)
three_dimensions = pytest.param(3, 4, marks=pytest.mark.heavy)
every_mesh = pytest.mark.parametrize(("dim", "elements"), [(2, 8), (2, 16), three_dimensions])


@lru_cache(maxsize=None)
def meshed(dim, elements):
    """Return the bodies, meshed by the script of the demo."""
    spec = importlib.util.spec_from_file_location("pile_mesh", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with TemporaryDirectory() as folder:
        module.pile_of_cylinders(Path(folder, "pile.msh"), dim, elements)
        return read_msh(Path(folder, "pile.msh"), MPI.COMM_SELF, gdim=dim)


@lru_cache(maxsize=None)
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


def error(dim, elements, name, unit, young=YOUNG):
    """Return the error of a force relative to statics with discs of the weight `unit`."""
    exact = np.zeros(dim)
    exact[:2] = unit * np.array(STATICS[name])
    found = resultants(solved(dim, elements, young))[name]
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


@every_contact
def test_force_by_statics(name):
    assert error(2, 16, name, CIRCLE) <= 1e-3


@every_contact
def test_force_is_that_of_statics_in_the_limit(name):
    """The polygon's weight converges with the square of the element size."""
    errors = [error(2, elements, name, CIRCLE) for elements in (4, 8, 16)]
    assert errors[1] <= 0.5 * errors[0]
    assert errors[2] <= 0.5 * errors[1]


def test_stiffer_bodies_are_closer_to_rigid_ones():
    """With the weight of the polygon, what is left is the displacement of the contacts."""
    weight = meshed_weight(2, 16, "top")
    soft, stiff = (
        max(error(2, 16, name, weight, young) for name in STATICS) for young in (YOUNG / 10, YOUNG)
    )
    assert soft <= 1e-3
    assert stiff <= 0.5 * soft


@pytest.mark.heavy
@every_contact
def test_force_by_statics_in_three_dimensions(name):
    weight = meshed_weight(3, 4, "top")
    assert error(3, 4, name, weight) <= 2e-3


@every_mesh
@pytest.mark.parametrize("body", ["left", "right", "top"])
def test_each_body_is_in_equilibrium(dim, elements, body):
    forces = resultants(solved(dim, elements))
    total = sum(force for name, force in forces.items() if name.startswith(body))
    if body != "top":
        total = total - forces[f"top {body}"]
    total[1] -= meshed_weight(dim, elements, body)
    np.testing.assert_allclose(total, 0.0, atol=1e-8 * CIRCLE)


@every_mesh
def test_contact_of_round_bodies_has_no_moment_about_the_axis(dim, elements):
    """All normals of the upper body meet in its axis."""
    for contact in solved(dim, elements).results:
        if contact.name.startswith("top"):
            arm = contact.coordinates[:, :2] - [0.0, 2.6 * RADIUS]
            n = contact.normal
            moment = contact.normal_force @ (arm[:, 0] * n[:, 1] - arm[:, 1] * n[:, 0])
            assert abs(moment) <= 1e-12 * CIRCLE * RADIUS


@pytest.mark.parametrize("elements", [8, 16])
def test_the_upper_disc_is_free_to_spin(elements):
    (motion,) = solved(2, elements).report.free_motions
    assert motion.endswith("rotation through (0, 0.65)")


@pytest.mark.heavy
def test_cylinders_are_free_to_slide_along_their_axes():
    """And the upper one to spin."""
    assert len(solved(3, 4).report.free_motions) == 4


def test_places_of_contact_are_some_elements_wide():
    """Not a single node, and not the whole tagged arc."""
    for contact in solved(2, 16).results:
        assert 3 <= np.count_nonzero(contact.active) <= contact.active.size / 2
