"""ESPRESO's test of mortar contact: a curved stiff block on a soft cube, 30 times as soft.

    python benchmarks/published/espreso_hertz.py

Published with the code (tests/feti/mortar/steadystate/inequality/linearElasticity3D/hertz, which
solves it by Total FETI with SMALBE): largest displacement 0.04947286 with hexahedra. The block is
beyond two edges of the cube, in the middle of its facets; the border of the contact is sharp there.
Metres, newtons, pascals.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, piecewise_constant, tag_facets
from fenics_tfeti.models import isotropic, small_strain, symmetry_plane

PUBLISHED = 0.04947286
BOTTOM, SIDES, CUBE, BLOCK, TOP = 1, (2, 3), 5, 6, 7

parts = [Box((0, 0, 0), (1, 1, 1), (10, 10, 10)), Box((2, 0, 1), (3, 1, 2), (18, 18, 18))]
bodies = boxes(MPI.COMM_SELF, parts, "hexahedron")
mesh = bodies.mesh
# the block is made beside the cube
marks = [(BOTTOM, lambda x: np.isclose(x[2], 0)), (TOP, lambda x: np.isclose(x[2], 2))]
marks += [(SIDES[0], lambda x: np.isclose(x[0], 0) | np.isclose(x[0], 2))]
marks += [(SIDES[1], lambda x: np.isclose(x[1], 0))]
marks += [(CUBE, lambda x: np.isclose(x[2], 1), 1), (BLOCK, lambda x: np.isclose(x[2], 1), 2)]
facets = tag_facets(mesh, marks, bodies.cell_tags)
block = mesh.geometry.x[:, 0] > 1.5
x, y, z = mesh.geometry.x[block].T
x = x - 2.0
mesh.geometry.x[block] = np.stack([x + 0.2, y + 0.2, z + 0.2 * (x**2 + y**2) * (2 - z)], axis=1)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
young = piecewise_constant(mesh, bodies.cell_tags, {1: 7e6, 2: 2.1e8})
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets)
bcs = [symmetry_plane(V, facets, side, axis=axis) for axis, side in enumerate(SIDES)]
fixed = fem.locate_dofs_topological(V, 2, facets.find(BOTTOM))
bcs.append(fem.dirichletbc(np.zeros(3), fixed, V))


def vertical(x: np.ndarray) -> np.ndarray:
    """Return the normals, along which the published gaps are."""
    return np.array([0.0, 0.0, 1.0])[:, None] * np.ones(x.shape[1])


pair = ContactPair(facets, slave=CUBE, master=BLOCK, roles="given", normal=vertical)
problem = ContactProblem(
    ufl.inner(isotropic(young, 0.3)(u), small_strain(v)) * ufl.dx,
    ufl.inner(-1e5 * ufl.FacetNormal(mesh), v) * ds(TOP),
    bcs=bcs,
    contacts=[pair],
    options={"rtol": 1e-8},
)
displacement = problem.solve().x.array.reshape(-1, 3)
computed = float(np.linalg.norm(displacement, axis=1).max())
print(f"largest displacement {computed:.7f} m, published {PUBLISHED:.7f} m")
