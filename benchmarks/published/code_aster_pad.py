"""Code_Aster SSNV503: a pad on a plane just before and just after it slides.

    python benchmarks/published/code_aster_pad.py

Pad of 40 x 20 mm (E = 210 GPa, nu = 0), plane strain, 2 mm above a rigid plane, coefficient of
friction 0.3. 300 MPa press it onto the plane, and its side is pushed by 99 % and by 101 % of what
friction holds. Weak springs, 4 N/mm along and 0.01 N/mm across the plane, hold it when it slides.
Published: 12 kN across and 3564 N along before it slides, a slip of 9 mm after. Millimetres,
newtons, megapascals.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets
from fenics_tfeti.models import isotropic

WIDTH, HEIGHT, GAP, FRICTION, PRESSURE = 40.0, 20.0, 2.0, 0.3, 300.0
BOTTOM, TOP, LEFT = 1, 2, 3

mesh = boxes(MPI.COMM_SELF, [Box((0, 0), (WIDTH, HEIGHT), (16, 8))], "quadrilateral").mesh
facets = tag_facets(
    mesh,
    [
        (BOTTOM, lambda x: np.isclose(x[1], 0.0)),
        (TOP, lambda x: np.isclose(x[1], HEIGHT)),
        (LEFT, lambda x: np.isclose(x[0], 0.0)),
    ],
)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
a = ufl.inner(isotropic(2.1e5, 0.0)(u), ufl.grad(v)) * ufl.dx
a += 4.0 / WIDTH * u[0] * v[0] * ds(TOP) + 0.01 / WIDTH * u[1] * v[1] * ds(TOP)
push = fem.Constant(mesh, 0.0)
plane = Plane(point=(0, -GAP), normal=(0, 1))
problem = ContactProblem(
    a,
    push * v[0] * ds(LEFT) - fem.Constant(mesh, PRESSURE) * v[1] * ds(TOP),
    contacts=[RigidObstacle(facets, BOTTOM, plane, friction=Coulomb(FRICTION))],
    options={"units": "mm-N-MPa"},
)
forces, slips = [], []
for share in (0.99, 1.01):
    push.value = share * FRICTION * PRESSURE * WIDTH / HEIGHT
    problem.solve()
    forces.append(np.abs(problem.report.contacts[0].force))
    slips.append(np.linalg.norm(problem.results[0].friction.slip, axis=1).mean())
print(f"99 %:  {forces[0][1]:9.2f} N across, published 12000; {forces[0][0]:8.2f} N along, 3564")
print(f"101 %: slip {slips[1]:.3f} mm, published 9   {slips[1] / 9 - 1:+.2%}")
print(f"{problem.report.products['total']} products with F")
