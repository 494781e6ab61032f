"""NAFEMS R0094, benchmark 1: a steel cylinder pressed onto an aluminium block, in the plane.

    python benchmarks/published/nafems_roller.py

Cylinder of radius 50 mm (E = 210 GPa), block of 200 x 200 mm (E = 70 GPa), nu = 0.3, plane strain,
pressed by 35 kN a millimetre. Half of both is meshed. Published, from Hertz's formulas: half width
of the contact 6.21 mm, largest pressure 3585.37 MPa. Millimetres, newtons, megapascals.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, piecewise_constant, read_msh
from fenics_tfeti.models import isotropic, symmetry_plane

sys.path.append(str(Path(__file__).parents[2] / "meshes"))
from half_disc_on_block import half_disc_on_block

R, SIDE, FORCE, POISSON, FINEST = 50.0, 100.0, 35e3, 0.3, 0.3
YOUNG = {"disc": 210e3, "block": 70e3}


with TemporaryDirectory() as folder:
    path = Path(folder) / "roller.msh"
    half_disc_on_block(path, R, SIDE, FINEST, near=9.0)
    bodies = read_msh(path, MPI.COMM_SELF, gdim=2)
mesh, facets, tags = bodies.mesh, bodies.facet_tags, bodies.names
E = piecewise_constant(mesh, bodies.cell_tags, {tags[name]: YOUNG[name] for name in YOUNG})
V = displacement_space(mesh, degree=2)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
foot = symmetry_plane(V, facets, tags["foot"], axis=1)
problem = ContactProblem(
    ufl.inner(isotropic(E, POISSON)(u), ufl.grad(v)) * ufl.dx,
    fem.Constant(mesh, -FORCE / (2 * R)) * v[1] * ds(tags["top"]),
    bcs=[symmetry_plane(V, facets, tags["axis"], axis=0), foot],
    contacts=[ContactPair(facets, slave=tags["face"], master=tags["arc"])],
    options={"units": "mm-N-MPa"},
)
problem.solve()
contact = problem.results[0]
x, p = contact.coordinates[:, 0], contact.pressure
inner = p > 0.3 * p.max()
slope, intercept = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
a, p0 = np.sqrt(-intercept / slope), np.sqrt(intercept)
print(f"half width  {a:8.3f} mm,  published    6.21   {a / 6.21 - 1:+.2%}")
print(f"pressure    {p0:8.2f} MPa, published 3585.37   {p0 / 3585.37 - 1:+.2%}")
print(f"largest at a node {p.max():.1f} MPa, {problem.report.products['total']} products with F")
