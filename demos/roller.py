r"""A steel roller between two plates: Hertz pressure and unresisted motions.

# A roller between two plates

A roller of radius 0.1 m lies between two steel plates, in plane strain. The lower plate is clamped
at its bottom. The upper one is guided at its sides, and a pressure of 10 MPa on its top presses it
onto the roller. Contact alone supports the roller and, in the vertical direction, the upper plate.

By Hertz's formulas, each of the two contact areas under the load P = 10 MPa x 0.4 m has the
half-width b and the pressure p, with

$$b^2 = \frac{4 P R}{\pi E^*}, \quad p(x) = p_0 \sqrt{1 - x^2 / b^2}, \quad
p_0 = \frac{2 P}{\pi b},$$

where $E^* = E / (2 (1 - \nu^2))$.

This demo illustrates how to

- pair slave and master nodes along a direction, here the vertical one;
- compare half-width and pressure with Hertz's formulas;
- find the unresisted motions in the report.

The contact conditions are linearised about the undeformed surfaces, and the normals of the slave
decide which motions they resist. Here the roller is the slave. All its normals meet in its axis: it
is free to rotate, but cannot slide. With the plates as slaves, whose normals are vertical, it is
free to slide, but cannot rotate.

Run it by `python demos/roller.py`; it draws pictures into `results/`.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import Along, ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Mesh

bodies = read_msh(here.parent / "meshes" / "roller.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names

# ## Linear elasticity in plane strain

E, nu = 2.1e11, 0.3
sigma = isotropic(E, nu)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
traction = fem.Constant(mesh, np.array([0.0, -10e6]))
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = ufl.inner(traction, v) * ds(tags["upper outer"])

# ## Supports

clamped = fem.locate_dofs_topological(V, 1, facet_tags.find(tags["lower outer"]))
bcs = [fem.dirichletbc(np.zeros(2), clamped, V)]
bcs += [symmetry_plane(V, facet_tags, tags[f"upper {side}"], 0) for side in ("left", "right")]

# ## Contact

contacts = [
    ContactPair(
        facet_tags,
        slave=tags[f"roller {where}"],
        master=tags[f"{plate} inner"],
        name=f"{plate} plate",
        partners=Along((0, 1)),
        normal=lambda x: x[:2],
    )
    for where, plate in (("below", "lower"), ("above", "upper"))
]
problem = ContactProblem(
    a, L, bcs=bcs, contacts=contacts, cell_tags=bodies.cell_tags, options={"rtol": 1e-8}
)
uh = problem.solve()

# ## Results
#
# The mean square of x, weighted by Hertz's pressure, is b^2 / 4.

report = problem.report
P, R = 10e6 * 0.4, 0.1
E_star = E / (2 * (1 - nu**2))
b = np.sqrt(4 * P * R / (np.pi * E_star))
p0 = 2 * P / (np.pi * b)
x = np.linspace(-b, b, 201)
curves = {"Hertz": (1e3 * x, p0 * np.sqrt(1 - (x / b) ** 2) / 1e6, "-")}
if mesh.comm.rank == 0:
    print("free motions:", *report.free_motions)
errors = {}
for contact, style in zip(problem.results, ("o", "x"), strict=True):
    contact = contact.gather()
    places = contact.coordinates[:, 0]
    force = contact.nodal_normal_force @ contact.normal
    width = 2 * np.sqrt(contact.nodal_normal_force @ places**2 / contact.nodal_normal_force.sum())
    peak = contact.pressure.max()
    errors[contact.name] = abs(force[1]) / P - 1, width / b - 1, peak / p0 - 1
    curves[contact.name] = 1e3 * places, contact.pressure / 1e6, style
    if mesh.comm.rank == 0:
        of_force, of_width, of_peak = errors[contact.name]
        print(
            f"{contact.name}: force {of_force:+.1e} of the load; half-width {of_width:+.2%}", end=""
        )
        print(f" and largest pressure {of_peak:+.2%} to Hertz")

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu)
draw_deformed(
    results / "roller.png",
    uh,
    stress,
    label="von Mises stress",
    limits=(0, 100),
    unit="MPa",
    title="A roller between two plates",
    scale=100,
)
draw_profile(
    results / "roller_pressure.png",
    curves,
    xlabel="x [mm]",
    ylabel="normal pressure [MPa]",
    title="Contact pressure on the roller",
)
