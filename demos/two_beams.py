"""Two elastic beams in contact (the academic benchmark of Dostál et al., sec. 11.11.1).

# Two beams

Two beams of 2 m x 1 m x 1 m lie on each other, the upper one shifted by 1 m. The lower one is
clamped at x = 0. The horizontal displacement of the upper one is zero at x = 3; in the vertical
direction contact alone supports it (the problem is *semicoercive*). A downward traction of 20 MPa
acts on its top and on its left face.

This demo illustrates how to

- read a tagged mesh from a file and pose linear elasticity in UFL, as in any dolfinx demo;
- define which surfaces may touch, and solve the contact problem;
- look at contact forces, stresses, and the report of the solver.

Run it by `python demos/two_beams.py`, or on several processes by
`mpirun -n 2 python demos/two_beams.py`; it writes pictures and fields into `results/`.
"""

import logging
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import (
    contact_fields,
    displacement_space,
    draw_deformed,
    draw_profile,
    read_msh,
    von_mises,
    write_fields,
)

here = Path(__file__).parent
results = Path("results")

# One line for each outer iteration of the solver, from rank 0.
logging.basicConfig(stream=sys.stdout, level=logging.WARNING, format="%(message)s", force=True)
logging.getLogger("fenics_tfeti").setLevel(logging.INFO)

# ## Mesh
#
# Each beam has nodes of its own, with matching grids on the two contact surfaces.

beams = read_msh(here.parent / "meshes" / "two_beams.msh", MPI.COMM_WORLD)
mesh, facet_tags, tags = beams.mesh, beams.facet_tags, beams.names

# ## Linear elasticity
#
# Steel: Young's modulus 210 GPa, Poisson's ratio 0.3.

E, nu = 2.1e11, 0.3
mu = fem.Constant(mesh, E / (2 * (1 + nu)))
lmbda = fem.Constant(mesh, E * nu / ((1 + nu) * (1 - 2 * nu)))


def epsilon(u):
    """Return the small strain."""
    return ufl.sym(ufl.grad(u))


def sigma(u):
    """Return the stress [Pa]."""
    return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(3) + 2 * mu * epsilon(u)


V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
traction = fem.Constant(mesh, np.array([0.0, 0.0, -20e6]))
a = ufl.inner(sigma(u), epsilon(v)) * ufl.dx
L = ufl.inner(traction, v) * ds(tags["loaded"])

# ## Supports

clamped = fem.locate_dofs_topological(V, 2, facet_tags.find(tags["clamped"]))
bcs = [fem.dirichletbc(np.zeros(3), clamped, V)]
for component in (0, 1):
    Vi = V.sub(component)
    guided = fem.locate_dofs_topological(Vi, 2, facet_tags.find(tags["guided"]))
    bcs.append(fem.dirichletbc(0.0, guided, Vi))

# ## Contact
#
# The bottom of the upper beam is the slave, the top of the lower one the master. There is no
# penalty parameter and no search distance to choose.

pair = ContactPair(facet_tags, slave=tags["contact_upper"], master=tags["contact_lower"])
problem = ContactProblem(a, L, bcs=bcs, contacts=[pair], options={"rtol": 1e-6})
uh = problem.solve()

# ## Results
#
# By the equilibrium of the upper beam, the contact force is 20 MPa x 3 m^2 = 60 MN.

report = problem.report
contact = problem.results[0].gather()
if mesh.comm.rank == 0:
    print(f"{report.unknowns['primal']} unknowns in {report.subdomains} subdomains")
    print(f"{report.products['total']} iterations, error {report.certificate.worst:.1e}")
    print(f"contact force {report.contacts[0].normal_force:.6e} N")

stress = von_mises(mesh, sigma(uh))
write_fields(results / "two_beams.pvd", [uh, stress, *contact_fields(V, problem.results)])
report.to_json(results / "two_beams.json")
draw_deformed(
    results / "two_beams.png", uh, stress, label="von Mises stress", unit="MPa", title="Two beams"
)

# Normal pressure along the axis y = 1/2 of the contact face.

axis = np.isclose(contact.coordinates[:, 1], 0.5)
order = np.argsort(contact.coordinates[axis, 0])
x, pressure = contact.coordinates[axis, 0][order], contact.pressure[axis][order]
draw_profile(
    results / "two_beams_pressure.png",
    {"normal pressure": (x, pressure / 1e6)},
    xlabel="x [m]",
    ylabel="normal pressure [MPa]",
    title="Contact pressure along the axis y = 0.5 m of the contact face",
    comm=mesh.comm,
)
