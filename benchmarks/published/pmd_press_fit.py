"""PMD, Package for Machine Design: a shaft in a hub that is too narrow, axisymmetric.

    python benchmarks/published/pmd_press_fit.py

Solid shaft of radius r1 = 0.5 m and hub of outer radius r2 = 1 m (E = 200 GPa, nu = 0.3), in plane
stress: discs with free faces. The meshes overlap by the interference 0.6667 mm. Published: contact
pressure E d / (r1 (1 + (r2^2 + r1^2) / (r2^2 - r1^2))) = 100 MPa
(https://pmd.it.cas.cz/en:example:nlin:5:start). Metres, newtons, pascals.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import axisymmetric_strain, isotropic, symmetry_plane

R1, R2, HEIGHT, INTERFERENCE = 0.5, 1.0, 0.1, 0.6667e-3
YOUNG, POISSON, PUBLISHED = 2e11, 0.3, 100e6
SHAFT, HUB, AXIS, BOTTOM = 1, 2, 3, 4

# the hub has more elements along the contact: nodes do not match
bodies = boxes(
    MPI.COMM_SELF,
    [
        Box((0.0, 0.0), (R1, HEIGHT), (10, 2), name="shaft"),
        Box((R1 - INTERFERENCE, 0.0), (R2, HEIGHT), (10, 3), name="hub"),
    ],
    "quadrilateral",
)
mesh, shaft, hub = bodies.mesh, bodies.names["shaft"], bodies.names["hub"]
facets = tag_facets(
    mesh,
    [
        (SHAFT, lambda x: np.isclose(x[0], R1), shaft),
        (HUB, lambda x: np.isclose(x[0], R1 - INTERFERENCE), hub),
        (AXIS, lambda x: np.isclose(x[0], 0.0), shaft),
        (BOTTOM, lambda x: np.isclose(x[1], 0.0), shaft),
        (BOTTOM, lambda x: np.isclose(x[1], 0.0), hub),
    ],
    bodies.cell_tags,
)
V = displacement_space(mesh, degree=2)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]
sigma = isotropic(YOUNG, POISSON, axisymmetric_strain)
problem = ContactProblem(
    ufl.inner(sigma(u), axisymmetric_strain(v)) * weight * ufl.dx,
    0.0,
    bcs=[symmetry_plane(V, facets, AXIS, axis=0), symmetry_plane(V, facets, BOTTOM, axis=1)],
    contacts=[ContactPair(facets, slave=HUB, master=SHAFT)],
    measure_weight=weight,
)
problem.solve()
pressure = problem.results[0].pressure
lowest, highest = 1e-6 * pressure.min(), 1e-6 * pressure.max()
print(f"pressure {lowest:.4f} to {highest:.4f} MPa, published {1e-6 * PUBLISHED:g}")
print(f"{problem.report.products['total']} products with F")
