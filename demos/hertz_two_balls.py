r"""Two elastic balls of different radii and materials, pressed together.

# Two balls

A ball of radius R1 = 50 mm is pressed onto a stiffer one of radius R2 = 100 mm. Formulas of Hertz
that hold for a radius a of the contact area much smaller than R1 and R2 are

$$a^3 = \frac{3 F R}{4 E^*}, \quad p(r) = p_0 \sqrt{1 - r^2 / a^2}, \quad
p_0 = \frac{3 F}{2 \pi a^2},$$

$$\frac{1}{R} = \frac{1}{R_1} + \frac{1}{R_2}, \quad
\frac{1}{E^*} = \frac{1 - \nu_1^2}{E_1} + \frac{1 - \nu_2^2}{E_2}.$$

This demo illustrates how to

- define contact of two curved bodies, whose nodes do not coincide: `Along` is the line on which
  the master node of a slave node is found;
- give each body its own material.

Run it by `python demos/hertz_two_balls.py`, or on several processes by
`mpirun -n 2 python demos/hertz_two_balls.py`; it draws pictures into `results/`. The mesh
comes from `meshes/half_balls.py`. All units are SI.
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

# ## Data
#
# Hertz's formula gives a = 4 mm for this force.

R1, E1, nu1 = 0.05, 2e9, 0.4
R2, E2, nu2 = 0.1, 6e9, 0.3
R = 1 / (1 / R1 + 1 / R2)
E_star = 1 / ((1 - nu1**2) / E1 + (1 - nu2**2) / E2)
force = 4 / 3 * E_star * 4e-3**3 / R

# ## Mesh
#
# A quarter of the halves that touch, at the origin. Projected along z, their nodes nearly coincide.

balls = read_msh(here.parent / "meshes" / "hertz_two_balls.msh", MPI.COMM_WORLD)
mesh, facet_tags, tags = balls.mesh, balls.facet_tags, balls.names

# ## Linear elasticity
#
# One form with one integral for each body.

sigma_1, sigma_2 = isotropic(E1, nu1), isotropic(E2, nu2)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=mesh, subdomain_data=balls.cell_tags)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
traction = fem.Constant(mesh, -force / (np.pi * R1**2))
a_form = ufl.inner(sigma_1(u), ufl.grad(v)) * dx(tags["upper"])
a_form += ufl.inner(sigma_2(u), ufl.grad(v)) * dx(tags["lower"])
L_form = traction * v[2] * ds(tags["flat_upper"])

# ## Supports
#
# The displacement normal to the planes of symmetry is zero, and so is that normal to the flat face
# of the lower ball. Contact alone supports the upper ball.

planes = ("symmetry_x", 0), ("symmetry_y", 1), ("flat_lower", 2)
bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in planes]

# ## Contact
#
# The two nodes of a pair are on a vertical line, and the gap between them is vertical too.

slave, master, down = tags["contact_upper"], tags["contact_lower"], (0, 0, -1)
pair = ContactPair(facet_tags, slave, master, partners=Along(down), normal=down)
problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[pair], options={"rtol": 1e-6})
uh = problem.solve()

# ## Comparison with Hertz
#
# As for the ball on a plane: a straight line through p^2 over r^2 gives a and p0.

report = problem.report
contact = problem.results[0].gather()
r, p = np.linalg.norm(contact.coordinates[:, :2], axis=1), contact.pressure
F = 4 * report.contacts[0].normal_force  # that of the quarter
a = (3 * F * R / (4 * E_star)) ** (1 / 3)
p0 = 3 * F / (2 * np.pi * a**2)
inner = p > 0.3 * p.max()
slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
a_fit, p0_fit = np.sqrt(-intercept / slope), np.sqrt(intercept)
if mesh.comm.rank == 0:
    print(f"F  = {F:8.2f} N, given {force:.2f} N, {report.products['total']} iterations")
    print(f"a  = {1e3 * a_fit:8.4f} mm,  Hertz {1e3 * a:8.4f}  {a_fit / a - 1:+.2%}")
    print(f"p0 = {1e-6 * p0_fit:8.3f} MPa, Hertz {1e-6 * p0:8.3f}  {p0_fit / p0 - 1:+.2%}")

# ## Pictures

is_upper = ufl.conditional(ufl.gt(ufl.SpatialCoordinate(mesh)[2], 0), 1.0, 0.0)
stress = von_mises(mesh, is_upper * sigma_1(uh) + (1 - is_upper) * sigma_2(uh))
radius = np.linspace(0, a, 400)
draw_profile(
    results / "hertz_two_balls_pressure.png",
    {
        "all nodes of the slave": (1e3 * r, 1e-6 * p, "o"),
        "Hertz": (1e3 * radius, 1e-6 * p0 * np.sqrt(1 - (radius / a) ** 2), "-"),
    },
    xlabel="distance from the axis [mm]",
    ylabel="normal pressure [MPa]",
    title="Two balls: contact pressure",
)
draw_deformed(
    results / "hertz_two_balls.png",
    uh,
    stress,
    label="von Mises stress",
    unit="MPa",
    scale=1,
    title="Two balls, a quarter of the halves that touch",
    camera=(-1.0, -1.3, 0.15),
    size=(1200, 1500),
)
