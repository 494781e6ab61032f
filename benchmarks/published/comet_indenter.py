"""comet-fenics: a rigid paraboloid pressed into an elastic block, by a quarter, in space.

    python benchmarks/published/comet_indenter.py

Unit cube (E = 10, nu = 0.3), with elements that are small at the contact, held at its bottom; the
paraboloid of radius R = 0.5 enters it by d = 0.02. Published, from Hertz's formulas: force
4/3 E / (1 - nu^2) a d, largest pressure E / (1 - nu^2) 2 d / (pi a) with a = sqrt(R d).
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl

from fenics_tfeti import ContactProblem, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic, symmetry_plane

YOUNG, POISSON, R, DEPTH, N = 10.0, 0.3, 0.5, 0.02, 24
TOP, BOTTOM, LEFT, FRONT = 1, 2, 3, 4

mesh = boxes(MPI.COMM_SELF, [Box((0, 0, -1), (1, 1, 0), (N, N, N // 2))], "hexahedron").mesh
x = mesh.geometry.x
x[:, :2] **= 2
x[:, 2] = -(x[:, 2] ** 2)
facets = tag_facets(
    mesh,
    [
        (TOP, lambda x: np.isclose(x[2], 0.0)),
        (BOTTOM, lambda x: np.isclose(x[2], -1.0)),
        (LEFT, lambda x: np.isclose(x[0], 0.0)),
        (FRONT, lambda x: np.isclose(x[1], 0.0)),
    ],
)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
sides = {LEFT: [0], FRONT: [1], BOTTOM: [0, 1, 2]}
problem = ContactProblem(
    ufl.inner(isotropic(YOUNG, POISSON)(u), ufl.grad(v)) * ufl.dx,
    0.0,
    bcs=[symmetry_plane(V, facets, tag, axis) for tag, axes in sides.items() for axis in axes],
    contacts=[
        RigidObstacle(
            facets, slave=TOP, obstacle=lambda x: (x[0] ** 2 + x[1] ** 2) / (2 * R) - DEPTH - x[2]
        )
    ],
)
problem.solve()
contact, a, modulus = problem.results[0], np.sqrt(R * DEPTH), YOUNG / (1 - POISSON**2)
force, pressure = 4 / 3 * modulus * a * DEPTH, 2 * modulus * DEPTH / (np.pi * a)
computed, largest = 4 * contact.nodal_normal_force.sum(), contact.pressure.max()
print(f"force    {computed:.5f}, published {force:.5f}   {computed / force - 1:+.2%}")
print(f"pressure {largest:.5f}, published {pressure:.5f}   {largest / pressure - 1:+.2%}")
print(f"{problem.report.products['total']} products with F")
