r"""A pair of gear teeth in contact, against the formulas of Hertz for a line contact.

# Gear teeth

A pinion of 20 teeth drives a wheel of 28; both are of a plastic, with involute teeth of module 4 mm
and pressure angle 20 degrees. One pair of teeth is in contact, at the pitch point. The normal there
touches the base circle of the pinion, of radius r_b = r_1 cos(20°), r_1 = 40 mm being the pitch
radius. By the equilibrium of moments the contact force is F = T / r_b, where T is the torque, both
per width of the gears. The flanks have the radii of curvature r_1 sin(20°) and r_2 sin(20°). By
Hertz's formulas the half-width a of the contact and its pressure p are

$$a^2 = \frac{4 F R}{\pi E^*}, \quad p(s) = p_0 \sqrt{1 - s^2 / a^2}, \quad
p_0 = \frac{2 F}{\pi a},$$

$$\frac{1}{R} = \left(\frac{1}{r_1} + \frac{1}{r_2}\right) \frac{1}{\sin 20^\circ}, \quad
E^* = \frac{E}{2 (1 - \nu^2)}.$$

This demo illustrates how to

- define contact of curved surfaces with meshes that do not match;
- let a body rotate: contact alone resists the torque;
- load a body by a given torque.

Run it by `python demos/gear_teeth.py`, or on several processes by
`mpirun -n 2 python demos/gear_teeth.py`; it draws pictures into `results/`. The mesh comes
from `meshes/gear_teeth.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Data
#
# A torque of 5 N m on gears of 10 mm width.

E, nu = 2.8e9, 0.35
torque = 5 / 0.01
r1, r2, angle = 0.04, 0.056, np.radians(20)

# ## Mesh
#
# A quarter of the pinion about the origin, and five teeth of the wheel.

gears = read_msh(here.parent / "meshes" / "gear_teeth.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = gears.mesh, gears.facet_tags, gears.names

# ## Linear elasticity, plane strain

sigma = isotropic(E, nu)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a_form = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx

# ## Torque
#
# Shear tractions c (y, -x) on the bore turn the pinion clockwise. Their moment is the integral of
# c (x^2 + y^2).

x, y = ufl.SpatialCoordinate(mesh)
bore = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)(tags["pinion bore"])
moment = mesh.comm.allreduce(fem.assemble_scalar(fem.form((x**2 + y**2) * bore)))
c = fem.Constant(mesh, torque / moment)
L_form = c * (y * v[0] - x * v[1]) * bore

# ## Supports
#
# The wheel is clamped at its bore. The cuts of the pinion are on the axes of coordinates; the
# radial displacement is zero there, which leaves it free to rotate about the origin.

clamped = fem.locate_dofs_topological(V, 1, facet_tags.find(tags["wheel bore"]))
bcs = [fem.dirichletbc(np.zeros(2), clamped, V)]
cuts = ("pinion first cut", 0), ("pinion last cut", 1)
bcs += [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in cuts]

# ## Contact
#
# The pinion's elements are larger: it is the slave. Other pairs of teeth carry no load.

flanks = ContactPair(facet_tags, slave=tags["pinion flank"], master=tags["wheel flank"])
problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[flanks])
uh = problem.solve()

# ## Comparison with Hertz
#
# A parabola through p^2 over the distance s along the flank gives a and p0.

nodes = problem.results[0].gather()
p = nodes.pressure
direction = np.radians(40.5)  # of the line of centres
pitch_point = r1 * np.array([np.cos(direction), np.sin(direction)])
along = direction + angle  # of the tangent of the flanks at the pitch point
s = (nodes.coordinates[:, :2] - pitch_point) @ [np.cos(along), np.sin(along)]

F = np.linalg.norm(problem.report.contacts[0].force)
statics = torque / (r1 * np.cos(angle))
R = np.sin(angle) / (1 / r1 + 1 / r2)
E_star = E / (2 * (1 - nu**2))
a = np.sqrt(4 * statics * R / (np.pi * E_star))
p0 = 2 * statics / (np.pi * a)

inner = p > 0.3 * p.max()
square, linear, constant = np.polyfit(s[inner], p[inner] ** 2, 2)
p0_fit = np.sqrt(constant - linear**2 / (4 * square))
a_fit = p0_fit / np.sqrt(-square)
if mesh.comm.rank == 0:
    print(f"F  = {F:9.2f} N/m, statics {statics:9.2f}  {F / statics - 1:+.3%}")
    print(f"a  = {1e3 * a_fit:9.4f} mm,  Hertz   {1e3 * a:9.4f}  {a_fit / a - 1:+.2%}")
    print(f"p0 = {1e-6 * p0_fit:9.3f} MPa, Hertz   {1e-6 * p0:9.3f}  {p0_fit / p0 - 1:+.2%}")

# ## Pictures
#
# The colours end at 10 MPa, so that the bending of the teeth can be seen.

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu)
near = np.abs(s) < 1.5 * a
line = np.linspace(-a, a, 400)
draw_profile(
    results / "gear_teeth_pressure.png",
    {
        "nodes of the pinion": (1e3 * s[near], 1e-6 * p[near], "o"),
        "Hertz": (1e3 * line, 1e-6 * p0 * np.sqrt(1 - (line / a) ** 2), "-"),
    },
    xlabel="distance from the pitch point [mm]",
    ylabel="normal pressure [MPa]",
    title="Two gear teeth: contact pressure",
)
draw_deformed(
    results / "gear_teeth.png",
    uh,
    stress,
    label="von Mises stress",
    limits=(0, 10),
    unit="MPa",
    scale=1,
    title="A pinion drives a wheel",
)
