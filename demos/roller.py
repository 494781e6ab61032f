"""A steel roller between two plates: Hertz pressure and unresisted motions.

# A roller between two plates

A roller of radius 0.1 m lies between two steel plates, in plane strain. The lower plate is clamped
at its bottom. The upper one is guided at its sides, and a pressure of 10 MPa on its top presses it
onto the roller. Contact alone supports the roller and, in the vertical direction, the upper plate.

By Hertz's formulas, each of the two contact areas under the load P = 10 MPa x 0.4 m has the
half-width b and the pressure p, with

    b^2 = 4 P R / (pi E*),   p(x) = p0 sqrt(1 - x^2 / b^2),   p0 = 2 P / (pi b),

where E* = E / (2 (1 - nu^2)).

This demo illustrates how to

- pair slave and master nodes along a direction, here the vertical one;
- compare half-width and pressure with Hertz's formulas;
- find the unresisted motions in the report.

The contact conditions are linearised about the undeformed surfaces, and the normals of the slave
decide which motions they resist. Here the roller is the slave. All its normals meet in its axis: it
is free to rotate, but cannot slide. With the plates as slaves, whose normals are vertical, it is
free to slide, but cannot rotate.

Run it by `python demos/roller.py`; it writes pictures and fields into `results/`.
"""

from __future__ import annotations

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

bodies = read_msh(here.parent / "meshes" / "roller.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names

# ## Linear elasticity in plane strain

E, nu = 2.1e11, 0.3
mu = fem.Constant(mesh, E / (2 * (1 + nu)))
lmbda = fem.Constant(mesh, E * nu / ((1 + nu) * (1 - 2 * nu)))


def epsilon(u):
    """Return the small strain."""
    return ufl.sym(ufl.grad(u))


def sigma(u):
    """Return the stress [Pa]."""
    return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(2) + 2 * mu * epsilon(u)


V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
traction = fem.Constant(mesh, np.array([0.0, -10e6]))
a = ufl.inner(sigma(u), epsilon(v)) * ufl.dx
L = ufl.inner(traction, v) * ds(tags["upper outer"])

# ## Supports

clamped = fem.locate_dofs_topological(V, 1, facet_tags.find(tags["lower outer"]))
bcs = [fem.dirichletbc(np.zeros(2), clamped, V)]
for side in ("upper left", "upper right"):
    guided = fem.locate_dofs_topological(V.sub(0), 1, facet_tags.find(tags[side]))
    bcs.append(fem.dirichletbc(0.0, guided, V.sub(0)))

# ## Contact

contacts = [
    ContactPair(
        facet_tags,
        slave=tags[f"roller {where}"],
        master=tags[f"{plate} inner"],
        name=f"{plate} plate",
        direction=(0, 1),
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
    print("unknowns     ", report.unknowns, "in", report.subdomains, "subdomains")
    print("products     ", report.products, "in", report.outer_iterations, "outer iterations")
    print("free motions ", *report.free_motions, sep="\n  ")
    print("certificate  ", {k: f"{v:.1e}" for k, v in report.certificate.numbers().items()})
errors = {}
for contact, style in zip(problem.results, ("o", "x"), strict=True):
    contact = contact.gather()
    places = contact.coordinates[:, 0]
    force = contact.normal_force @ contact.normal
    width = 2 * np.sqrt(contact.normal_force @ places**2 / contact.normal_force.sum())
    peak = contact.pressure.max()
    errors[contact.name] = abs(force[1]) / P - 1, width / b - 1, peak / p0 - 1
    curves[contact.name] = 1e3 * places, contact.pressure / 1e6, style
    if mesh.comm.rank == 0:
        of_force, of_width, of_peak = errors[contact.name]
        print(f"{contact.name}: force {abs(force[1]):.6e} N/m, load {P:.6e} N/m  {of_force:+.1e}")
        print(f"  half-width {1e3 * width:.4f} mm,  Hertz {1e3 * b:.4f}  {of_width:+.2%}")
        print(f"  largest p {peak / 1e6:.1f} MPa, Hertz {p0 / 1e6:.1f}  {of_peak:+.2%}")

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu)
write_fields(results / "roller.pvd", [uh, stress, *contact_fields(V, problem.results)])
report.to_json(results / "roller.json")
stress.x.array[:] = np.minimum(stress.x.array, 100e6)
draw_deformed(
    results / "roller.png",
    uh,
    stress,
    label="von Mises stress (capped)",
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
    comm=mesh.comm,
)
