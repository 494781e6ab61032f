"""Code_Aster SSNV128: a plate pressed onto a rigid plane with friction and pushed from the side.

    python benchmarks/published/code_aster_plate.py

Half of a plate of 80 x 40 mm (E = 130 GPa, nu = 0.2), plane strain, coefficient of friction 1. 50
MPa press its top, 150 MPa its left side, in one step. The plate sticks at the symmetry plane and
slips towards it on the left. Published: displacements along the plane at five points below the
plate, by GRECO, in micrometres. Elements of 1.25 mm, of degree 1, as there. SI units.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic, symmetry_plane

SIDE, N = 0.04, 32
BOTTOM, TOP, LEFT, MIDDLE = 1, 2, 3, 4
PUBLISHED = {0.0: 28.6, 0.00125: 27.2, 0.005: 22.8, 0.0075: 19.8, 0.01125: 15.0}

mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (SIDE, SIDE), (N, N))], "quadrilateral").mesh
facets = tag_facets(
    mesh,
    [
        (BOTTOM, lambda x: np.isclose(x[1], 0.0)),
        (TOP, lambda x: np.isclose(x[1], SIDE)),
        (LEFT, lambda x: np.isclose(x[0], 0.0)),
        (MIDDLE, lambda x: np.isclose(x[0], SIDE)),
    ],
)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
problem = ContactProblem(
    ufl.inner(isotropic(130e9, 0.2)(u), ufl.grad(v)) * ufl.dx,
    fem.Constant(mesh, 150e6) * v[0] * ds(LEFT) - fem.Constant(mesh, 50e6) * v[1] * ds(TOP),
    bcs=[symmetry_plane(V, facets, MIDDLE, axis=0)],
    contacts=[
        RigidObstacle(facets, BOTTOM, Plane(point=(0, 0), normal=(0, 1)), friction=Coulomb(1.0))
    ],
)
uh = problem.solve()
x, moved = V.tabulate_dof_coordinates(), 1e6 * uh.x.array.reshape(-1, 2)[:, 0]
computed = []
for place, published in PUBLISHED.items():
    (node,) = np.flatnonzero(np.isclose(x[:, 0], place) & np.isclose(x[:, 1], 0.0))
    computed.append(moved[node])
    error = moved[node] / published - 1
    print(f"x = {1e3 * place:5.2f} mm: {moved[node]:.2f} um, published {published}   {error:+.2%}")
print(f"{problem.report.products['total']} products with F")
