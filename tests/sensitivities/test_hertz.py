"""Stiffness and pressures of a ball and a roller on a plane, by Hertz's formulas.

The set of nodes in contact stays under small changes, while Hertz's area grows: derivatives are
those of a punch, and right up to the size of a facet over the radius of contact.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, read_msh
from fenics_tfeti.models import axisymmetric_strain, isotropic, small_strain, symmetry_plane

pytestmark = pytest.mark.once

MESH = Path(__file__).parents[2] / "meshes" / "hertz_cylinder.msh"
R, E, POISSON, HALF_WIDTH = 0.05, 2e9, 0.3, 3e-3
STIFFNESS = E / (1 - POISSON**2)
FACET = 2.5e-4  # length of the facets in contact [m]
FORCES = {
    "ball": 4 / 3 * STIFFNESS * HALF_WIDTH**3 / R,
    "roller": np.pi * STIFFNESS * HALF_WIDTH**2 / (4 * R),
}


def pressed(kind, approach=None):
    """Return a quarter's problem, solved, and its pressure on the flat; a motion in place of it."""
    roller = read_msh(MESH, MPI.COMM_SELF, gdim=2)
    mesh, facet_tags, tags = roller.mesh, roller.facet_tags, roller.names
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    is_ball = kind == "ball"
    weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0] if is_ball else None
    factor = fem.Constant(mesh, 1.0) if weight is None else weight
    strain = axisymmetric_strain if is_ball else small_strain
    load = FORCES[kind] / (np.pi * R**2 if is_ball else 2 * R)
    pressure = fem.Constant(mesh, load if approach is None else 0.0)
    a = ufl.inner(isotropic(E, POISSON, strain)(u), strain(v)) * factor * ufl.dx
    L = -pressure * v[1] * factor * ds(tags["flat"])
    bcs = [symmetry_plane(V, facet_tags, tags["symmetry_x"], axis=0)]
    if approach is not None:
        bcs.append(symmetry_plane(V, facet_tags, tags["flat"], axis=1))
    plane = Plane((0.0, approach or 0.0), (0.0, 1.0))
    contact = RigidObstacle(facet_tags, tags["contact"], obstacle=plane, name="joint")
    options = {"rtol": 1e-10, "subdomain_size": 600}
    problem = ContactProblem(
        a, L, bcs=bcs, contacts=[contact], measure_weight=weight, options=options
    )
    problem.solve()
    return problem, pressure


def test_stiffness_of_a_ball():
    """dF/dd = 2 E* a."""
    problem, _ = pressed("ball", approach=HALF_WIDTH**2 / R)
    force = problem.results["joint"].nodal_normal_force.sum()
    radius = (3 * force * R / (4 * STIFFNESS)) ** (1 / 3)
    stiffness = problem.adjoint(forces={"joint": (0.0, 1.0)}).by_obstacle("joint")[1]
    assert stiffness == pytest.approx(2 * STIFFNESS * radius, rel=FACET / HALF_WIDTH)


@pytest.mark.parametrize(("kind", "power"), [("ball", 1 / 3), ("roller", 1 / 2)])
def test_largest_pressure(kind, power):
    """The pressure in the middle is proportional to a power of the force."""
    problem, pressure = pressed(kind)
    joint, force = problem.results["joint"], FORCES[kind]
    largest = (1.5 if kind == "ball" else 2.0 / HALF_WIDTH) * force / np.pi
    largest /= HALF_WIDTH**2 if kind == "ball" else 1.0
    weights = (joint.coordinates[:, 0] < FACET / 2) / joint.area
    by_pressure = problem.adjoint(normal_forces={"joint": weights}).by(pressure)
    slope = float(by_pressure) * float(pressure.value) / force
    assert slope == pytest.approx(power * largest / force, rel=FACET / HALF_WIDTH)
