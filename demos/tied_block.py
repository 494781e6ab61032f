r"""A block with a bore, of a fine and a coarse part that are tied together.

# Tied block

A block with a bore of radius R = 10 mm is stretched along x by the stress S. The stress varies near
the bore only, where it rises to 3 S. Therefore the block is meshed in two parts: a fine part about
the bore, and a coarse one for the rest. Where they meet, the facets of the coarse part are three
times as large, and the parts have no nodes in common. Two `TiedPair`s hold them together.

The displacement of an infinite body is known (Kirsch; plane strain, kappa = 3 - 4 nu, in polar
coordinates r and t):

$$u_x = \frac{S R}{8 \mu} \left[ \frac{r}{R} (\kappa + 1) \cos t
+ \frac{2 R}{r} \big( (1 + \kappa) \cos t + \cos 3 t \big) - \frac{2 R^3}{r^3} \cos 3 t \right],$$

$$u_y = \frac{S R}{8 \mu} \left[ \frac{r}{R} (\kappa - 3) \sin t
+ \frac{2 R}{r} \big( (1 - \kappa) \sin t + \sin 3 t \big) - \frac{2 R^3}{r^3} \sin 3 t \right].$$

Its tractions are applied to the outside of the block, so that it is the exact solution here.

This demo illustrates how to

- tie parts of a body that are meshed apart;
- compare with an exact solution.

Run it by `python demos/tied_block.py`, or on several processes by
`mpirun -n 2 python demos/tied_block.py`; it draws a picture into `results/`. The mesh comes
from `meshes/tied_block.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, TiedPair
from fenics_tfeti.io import displacement_space, draw_deformed, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Mesh
#
# A quarter of the block; x = 0 and y = 0 are planes of symmetry.

block = read_msh(here.parent / "meshes" / "tied_block.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = block.mesh, block.facet_tags, block.names

# ## Linear elasticity, plane strain

E, nu, S, R = 2.1e11, 0.3, 1e8, 0.01
mu, sigma = E / (2 * (1 + nu)), isotropic(E, nu)

# ## The exact solution

x = ufl.SpatialCoordinate(mesh)
r = ufl.sqrt(ufl.inner(x, x))
cos, sin = x[0] / r, x[1] / r
cos3, sin3 = 4 * cos**3 - 3 * cos, 3 * sin - 4 * sin**3
kappa = 3 - 4 * nu
near, far = 2 * R / r, r / R
exact = (S * R / (8 * mu)) * ufl.as_vector(
    [
        far * (kappa + 1) * cos + near * ((1 + kappa) * cos + cos3) - near**3 / 4 * cos3,
        far * (kappa - 3) * sin + near * ((1 - kappa) * sin + sin3) - near**3 / 4 * sin3,
    ]
)

# ## Forms and supports

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
degree = {"quadrature_degree": 4}
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags, metadata=degree)
a_form = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
traction = ufl.dot(sigma(exact), ufl.FacetNormal(mesh))
L_form = ufl.inner(traction, v) * ds(tags["outside"])
sides = ("symmetry_x", 0), ("symmetry_y", 1)
bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in sides]

# ## Tied surfaces
#
# One pair for each side of the square. The coarse part, with the larger facets, is the slave.

tied = [
    TiedPair(facet_tags, slave=tags[f"coarse {side}"], master=tags[f"fine {side}"], name=side)
    for side in ("right", "top")
]
problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=tied)
uh = problem.solve()

# ## Comparison with the exact solution
#
# The error of the displacement in the mean of squares, in each part, relative to the displacement.
# With a mesh as fine in the coarse part (`--coarser 2`), of four times as many unknowns, it is
# 0.15 % in the fine part instead of 0.27 %.

dx = ufl.Measure("dx", domain=mesh, subdomain_data=block.cell_tags, metadata=degree)


def mean_square(field, part):
    """Return the root of the integral of the field's square over a part."""
    form = fem.form(ufl.inner(field, field) * dx(tags[part]))
    return np.sqrt(mesh.comm.allreduce(fem.assemble_scalar(form)))


errors = {
    part: mean_square(uh - exact, part) / mean_square(exact, part)
    for part in ("fine part", "coarse part")
}
if mesh.comm.rank == 0:
    print(f"{problem.report.unknowns['tied']} tied conditions")
    for part, error in errors.items():
        print(f"{part}: error of the displacement {error:.3%}")

# ## Picture

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu)
draw_deformed(
    results / "tied_block.png",
    uh,
    stress,
    label="von Mises stress",
    unit="MPa",
    title="A fine and a coarse part, tied",
)
