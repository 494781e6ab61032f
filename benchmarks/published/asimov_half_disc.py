"""asimov-contact: half a disc pressed onto a block, in the plane, its demo of Hertz contact.

    python benchmarks/published/asimov_half_disc.py

Half disc of radius 8, block of 20 x 20, E = 200 and nu = 0.3 for both, plane strain, pressed by
0.625 on its diameter. Half of both is meshed. Published, from Hertz's formulas: half width of the
contact 2 sqrt(R P / (pi E*)) = 0.9628, largest pressure 2 P / (pi a) = 6.612, with P = 10.
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
from fenics_tfeti.io import displacement_space, read_msh
from fenics_tfeti.models import isotropic, symmetry_plane

sys.path.append(str(Path(__file__).parents[2] / "meshes"))
from half_disc_on_block import half_disc_on_block

R, SIDE, PRESSURE, YOUNG, POISSON, FINEST = 8.0, 10.0, 0.625, 200.0, 0.3, 0.05
HALF_WIDTH = 2 * np.sqrt(2 * R**2 * PRESSURE / (np.pi * YOUNG / (2 * (1 - POISSON**2))))
LARGEST = 4 * R * PRESSURE / (np.pi * HALF_WIDTH)


with TemporaryDirectory() as folder:
    path = Path(folder) / "roller.msh"
    half_disc_on_block(path, R, SIDE, FINEST, near=1.4)
    bodies = read_msh(path, MPI.COMM_SELF, gdim=2)
mesh, facets, tags = bodies.mesh, bodies.facet_tags, bodies.names
V = displacement_space(mesh, degree=2)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
foot = symmetry_plane(V, facets, tags["foot"], axis=1)
problem = ContactProblem(
    ufl.inner(isotropic(YOUNG, POISSON)(u), ufl.grad(v)) * ufl.dx,
    fem.Constant(mesh, -PRESSURE) * v[1] * ds(tags["top"]),
    bcs=[symmetry_plane(V, facets, tags["axis"], axis=0), foot],
    contacts=[ContactPair(facets, slave=tags["face"], master=tags["arc"])],
)
problem.solve()
contact = problem.results[0]
x, p = contact.coordinates[:, 0], contact.pressure
inner = p > 0.3 * p.max()
slope, intercept = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
a, p0 = np.sqrt(-intercept / slope), np.sqrt(intercept)
print(f"half width {a:.4f}, published {HALF_WIDTH:.4f}   {a / HALF_WIDTH - 1:+.2%}")
print(f"pressure   {p0:.4f}, published {LARGEST:.4f}   {p0 / LARGEST - 1:+.2%}")
print(f"{problem.report.products['total']} products with F")
