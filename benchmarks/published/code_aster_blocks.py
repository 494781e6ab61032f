"""Code_Aster SSNP121: two blocks meshed differently, pressed together: the patch test of contact.

    python benchmarks/published/code_aster_blocks.py

Blocks of 1 x 1 m with 12 x 12 and 11 x 11 elements (E = 2 MPa, nu = 0), plane strain. The top
moves down by 0.1 m. Published, exact: pressure 1e5 Pa and displacement -0.05 m on all of the
contact; Code_Aster is within 1 % with its continuous formulation, within 7.5 % with node to facet.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space
from fenics_tfeti.models import isotropic

blocks = boxes(
    MPI.COMM_SELF,
    [Box((0, 0), (1, 1), (11, 11)), Box((0, 1), (1, 2), (12, 12))],
    "quadrilateral",
)
V = displacement_space(blocks.mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
bcs = []
for height, moved in ((0.0, 0.0), (2.0, -0.1)):
    dofs = fem.locate_dofs_geometrical(V, lambda x, y=height: np.isclose(x[1], y))
    bcs.append(fem.dirichletbc(np.array([0.0, moved]), dofs, V))
problem = ContactProblem(
    ufl.inner(isotropic(2e6, 0.0)(u), ufl.grad(v)) * ufl.dx,
    0.0,
    bcs=bcs,
    contacts="auto",
    options={"rtol": 1e-10},
)
uh = problem.solve()
contact = problem.results[0]
down = uh.x.array.reshape(-1, 2)[contact.dofs, 1]
pressure_error = np.abs(contact.pressure / 1e5 - 1).max()
displacement_error = np.abs(down / -0.05 - 1).max()
print(f"pressure     {contact.pressure.mean():10.2f} Pa, published 1e5     {pressure_error:.1e}")
print(f"displacement {down.mean():10.6f} m,  published -0.05   {displacement_error:.1e}")
print(f"{problem.report.products['total']} products with F")
