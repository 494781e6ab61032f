r"""A long elastic roller on a rigid plane, and in a rigid groove (plane strain).

# Hertz's roller

A roller of radius R1 = 50 mm is pressed by a force F' per unit of length, first onto a rigid plane,
then into a rigid groove of radius R2 = 100 mm. The contact area is a strip of half-width a.
Formulas of Hertz that hold for a much smaller than the radii are

$$a^2 = \frac{4 F' R}{\pi E^*}, \quad p(x) = p_0 \sqrt{1 - x^2 / a^2}, \quad
p_0 = \frac{2 F'}{\pi a},$$

with $1/R = 1/R_1$ on the plane, $1/R = 1/R_1 - 1/R_2$ in the groove, and $E^* = E / (1 - \nu^2)$.

This demo illustrates how to

- solve in two dimensions, in a state of plane strain;
- press one body against different rigid obstacles: a `Plane`, and a `Sphere`, which is a disc in
  two dimensions, and with `hollow=True` the outside of the disc.

Run it by `python demos/hertz_cylinder.py`; it draws pictures into `results/`. The mesh comes from
`meshes/half_balls.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle, Sphere
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Data
#
# A hard plastic. Hertz's formula gives a = 3 mm on the plane for this force.

R1, R2, E, nu = 0.05, 0.1, 2e9, 0.3
E_star = E / (1 - nu**2)
force = np.pi * E_star * 3e-3**2 / (4 * R1)

# ## Mesh
#
# A quarter of the circle. It touches the plane at the origin; x = 0 is a plane of symmetry.

roller = read_msh(here.parent / "meshes" / "hertz_cylinder.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = roller.mesh, roller.facet_tags, roller.names

# ## Linear elasticity, plane strain

sigma = isotropic(E, nu)
traction = fem.Constant(mesh, -force / (2 * R1))
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a_form = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L_form = traction * v[1] * ds(tags["flat"])
bcs = [symmetry_plane(V, facet_tags, tags["symmetry_x"], axis=0)]

# ## Two obstacles
#
# Contact alone supports the roller in the vertical direction.
#
# The formulas are evaluated for the computed contact force, twice that of the half.
#
# The pressure of a node is its contact force over the length that belongs to it. By Hertz's
# formula, p^2 is a linear function of x^2. A straight line through the nodes with more than 30 % of
# the largest pressure gives a and p0.

cases = {
    "plane": (R1, Plane(point=(0, 0), normal=(0, 1))),
    "groove": (1 / (1 / R1 - 1 / R2), Sphere(centre=(0, R2), radius=R2, hollow=True)),
}
curves, errors = {}, {}
for (name, (R, obstacle)), style in zip(cases.items(), ("o", "s"), strict=True):
    contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=obstacle)
    problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[contact])
    uh = problem.solve()

    nodes = problem.results[0].gather()
    x, p = nodes.coordinates[:, 0], nodes.pressure
    F = 2 * problem.report.contacts[0].normal_force
    a = np.sqrt(4 * F * R / (np.pi * E_star))
    p0 = 2 * F / (np.pi * a)
    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
    a_fit, p0_fit = np.sqrt(-intercept / slope), np.sqrt(intercept)
    errors[name] = a_fit / a - 1, p0_fit / p0 - 1
    if mesh.comm.rank == 0:
        print(f"{name}: {problem.report.products['total']} iterations")
        print(f"  a  = {1e3 * a_fit:7.4f} mm,  Hertz {1e3 * a:7.4f}  {errors[name][0]:+.2%}")
        print(f"  p0 = {1e-6 * p0_fit:7.3f} MPa, Hertz {1e-6 * p0:7.3f}  {errors[name][1]:+.2%}")
    line = np.linspace(0, a, 400)
    curves[name] = (1e3 * x, 1e-6 * p, style)
    curves[f"Hertz, {name}"] = (1e3 * line, 1e-6 * p0 * np.sqrt(1 - (line / a) ** 2), "-")

# ## Pictures

draw_profile(
    results / "hertz_cylinder_pressure.png",
    curves,
    xlabel="distance from the middle [mm]",
    ylabel="normal pressure [MPa]",
    title="Roller on a rigid plane, and in a rigid groove",
)
draw_deformed(
    results / "hertz_cylinder.png",
    uh,
    von_mises(mesh, sigma(uh), poisson_ratio=nu),
    label="von Mises stress",
    unit="MPa",
    scale=1,
    title="A quarter of the roller in the groove",
)
