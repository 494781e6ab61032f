"""Pressures are forces over present areas, with the weight of the measure where the surface is."""

from mpi4py import MPI

import numpy as np
import pytest
from pairwise import pairwise

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactPair,
    ContactProblem,
    Deformed,
    NonlinearContactProblem,
    RigidObstacle,
    Tresca,
)
from fenics_tfeti.io import Box, boxes, contact_fields, displacement_space, tag_facets
from fenics_tfeti.models import axisymmetric_strain, isotropic, small_strain, symmetry_plane

LOWER, UPPER, TOP, FLOOR, AXIS = 1, 2, 3, 4, 5
DOWN, BOUND = 0.2, 1e-7
G, LAME = 1 / 2.6, 0.3 / 0.52  # E = 1, nu = 0.3


def pressed(kind, cells, degree, gaps):
    """Return the problem of two halves of a block that a plane presses, and the weight of dx."""
    halves = [Box((0, 0), (1, 0.5), (3, 1)), Box((0, 0.5), (1, 1), (cells, 1))]
    bodies = boxes(MPI.COMM_WORLD, halves, "quadrilateral")
    tags = tag_facets(
        bodies.mesh,
        [
            (LOWER, lambda x: np.isclose(x[1], 0.5), 1),
            (UPPER, lambda x: np.isclose(x[1], 0.5), 2),
            (TOP, lambda x: np.isclose(x[1], 1)),
            (FLOOR, lambda x: np.isclose(x[1], 0)),
            (AXIS, lambda x: np.isclose(x[0], 0)),
        ],
        bodies.cell_tags,
    )
    V = displacement_space(bodies.mesh, degree=degree)
    u, v = fem.Function(V), ufl.TestFunction(V)
    r = ufl.SpatialCoordinate(bodies.mesh)[0]
    is_axisymmetric = kind == "axisymmetric"
    weight = 2 * ufl.pi * r if is_axisymmetric else fem.Constant(bodies.mesh, 1.0)
    dx = ufl.dx(metadata={"quadrature_degree": 4})
    # so little friction that the state stays uniform
    friction = Tresca(BOUND)
    contacts = [
        ContactPair(tags, LOWER, UPPER, name="pair", friction=friction),
        RigidObstacle(tags, TOP, lambda x: 1 - DOWN - x[1], name="plane", friction=friction),
    ]
    bcs = [symmetry_plane(V, tags, FLOOR, 1), symmetry_plane(V, tags, AXIS, 0)]
    data = {"bcs": bcs, "contacts": contacts, "measure_weight": weight}
    if gaps is not None:
        du, strain = ufl.TrialFunction(V), axisymmetric_strain if is_axisymmetric else small_strain
        a = weight * ufl.inner(isotropic(1.0, 0.3, strain)(du), strain(v)) * dx
        return ContactProblem(a, 0, gaps=gaps, u=u, options={"rtol": 1e-9}, **data), weight
    H = ufl.grad(u)
    hoop = u[0] / r if is_axisymmetric else 0
    F = ufl.as_tensor([[1 + H[0, 0], H[0, 1], 0], [H[1, 0], 1 + H[1, 1], 0], [0, 0, 1 + hoop]])
    J = ufl.det(F)
    W = weight * (G / 2 * (ufl.inner(F, F) - 3) - G * ufl.ln(J) + LAME / 2 * ufl.ln(J) ** 2)
    options = {"newton_rtol": 1e-10}
    return NonlinearContactProblem(ufl.derivative(W * dx, u, v), u, options=options, **data), weight


def largest(comm, values):
    return comm.allreduce(float(np.max(values, initial=-np.inf)), MPI.MAX)


# pairs of nodes of degree 1, mortars of both degrees
MESHES = [(3, 1), (4, 1), (4, 2)]


@pytest.mark.ranks
@pytest.mark.parametrize(
    ("kind", "mesh", "gaps"),
    pairwise(["plane strain", "axisymmetric"], MESHES, [None, Deformed(1e-6)]),
)
def test_uniform_pressure(kind, mesh, gaps):
    cells, degree = mesh
    problem, _ = pressed(kind, cells, degree, gaps)
    problem.solve()
    end = 1 + largest(MPI.COMM_WORLD, problem.u.x.array.reshape(-1, 2)[:, 0])
    assert end > 1.05
    area, nominal_area = (np.pi * end**2, np.pi) if kind == "axisymmetric" else (end, 1.0)
    for result in problem.results:
        whole, force = result.gather(), abs(result.force[1])
        np.testing.assert_allclose(whole.pressure, force / area, rtol=1e-5)
        np.testing.assert_allclose(whole.nominal_pressure, force / nominal_area, rtol=1e-5)
        assert whole.area.sum() == pytest.approx(area, rel=1e-5)
        if gaps is None:
            friction = whole.friction
            sliding = whole.coordinates[:, 0] > 0.0  # at the plane of symmetry nothing slides
            bound = BOUND * whole.area[sliding]
            np.testing.assert_allclose(friction.bound[sliding], bound, rtol=1e-5)
            traction = np.linalg.norm(friction.traction, axis=1)[sliding]
            # the halves of the block hardly slide along each other
            least = BOUND if result.name == "plane" else 0.0
            assert (1 - 1e-4) * least <= traction.min() <= traction.max() <= (1 + 1e-4) * BOUND
    pressure = contact_fields(problem.u.function_space, problem.results[1:]).pressure
    assert largest(MPI.COMM_WORLD, pressure.x.array) == pytest.approx(force / area, rel=1e-5)


@pytest.mark.once
@pytest.mark.parametrize("gaps", [None, Deformed(1e-6)], ids=["finite strains", "exact"])
@pytest.mark.parametrize(("cells", "degree"), [(3, 1), (4, 2)])
def test_a_changed_weight_counts_in_the_next_solve(cells, degree, gaps):
    """Twice the thickness: twice the forces, areas and bounds of friction."""
    problem, thickness = pressed("plane strain", cells, degree, gaps)
    problem.solve()
    first = list(problem.results)
    thickness.value = 2.0
    problem.solve()
    for old, new in zip(first, problem.results, strict=True):
        for quantity in ("area", "nodal_normal_force"):
            expected = 2.0 * getattr(old, quantity)
            np.testing.assert_allclose(getattr(new, quantity), expected, rtol=1e-4)
        np.testing.assert_allclose(new.pressure, old.pressure, rtol=1e-4)
        np.testing.assert_allclose(new.nominal_pressure, old.nominal_pressure, rtol=1e-4)
        sliding = new.friction.bound > 0.0
        np.testing.assert_allclose(
            new.friction.bound[sliding], BOUND * new.area[sliding], rtol=1e-4
        )
