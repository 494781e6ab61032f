r"""Hertz's ball once more, in the plane of its meridian.

# Axisymmetric ball

The ball of `demos/hertz_ball.py`, and its load, do not change around the axis. The displacement in
cylindrical coordinates (r, z) is a function of r and z, and the mesh that of a quarter of a circle:

$$\varepsilon = \begin{pmatrix}
u_{r,r} & (u_{r,z} + u_{z,r}) / 2 & 0 \\ \cdot & u_{z,z} & 0 \\ 0 & 0 & u_r / r
\end{pmatrix},$$

and all integrals have the factor 2 pi r. Forces are then those of the whole ball. (With the factor
r they are forces per radian.)

Nodal forces become pressures by the integrals of the shape functions over the surface, so that the
problem has to know the factor as well: it is its `measure_weight`.

This demo illustrates how to

- write an axisymmetric problem, with the strain of `fenics_tfeti.models`;
- give the weight of the surface measure.

Run it by `python demos/axisymmetric_ball.py`, or on several processes by
`mpirun -n 2 python demos/axisymmetric_ball.py`; it draws a picture into `results/`. The mesh, the
same as that of `demos/hertz_cylinder.py`, comes from `meshes/half_balls.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_profile, read_msh
from fenics_tfeti.models import axisymmetric_strain, isotropic, symmetry_plane

here = Path(__file__).parent
comm = MPI.COMM_WORLD

# ## Data
#
# A hard plastic. Hertz's formula gives a = 3 mm for this force.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
force = 4 / 3 * E_star * 3e-3**3 / R

meridian = read_msh(here.parent / "meshes" / "hertz_cylinder.msh", comm, gdim=2)
mesh, facet_tags, tags = meridian.mesh, meridian.facet_tags, meridian.names

# ## The axisymmetric forms

r = ufl.SpatialCoordinate(mesh)[0]
weight = 2 * ufl.pi * r
sigma = isotropic(E, nu, axisymmetric_strain)
traction = fem.Constant(mesh, -force / (np.pi * R**2))
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a_form = ufl.inner(sigma(u), axisymmetric_strain(v)) * weight * ufl.dx
L_form = traction * v[1] * weight * ds(tags["flat"])

# On the axis the radial displacement is zero.

bcs = [symmetry_plane(V, facet_tags, tags["symmetry_x"], axis=0)]
ground = Plane(point=(0, 0), normal=(0, 1))
contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=ground)
problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[contact], measure_weight=weight)
problem.solve()

# ## Comparison with Hertz
#
# By Hertz's formula, p^2 is a linear function of r^2. A straight line through the nodes with more
# than 30 % of the largest pressure gives a and p0.

nodes = problem.results[0].gather()
radii, p = nodes.coordinates[:, 0], nodes.pressure
F = problem.report.contacts[0].normal_force
a = (3 * F * R / (4 * E_star)) ** (1 / 3)
p0 = 3 * F / (2 * np.pi * a**2)
inner = p > 0.3 * p.max()
slope, intercept = np.polyfit(radii[inner] ** 2, p[inner] ** 2, 1)
a_fit, p0_fit = np.sqrt(-intercept / slope), np.sqrt(intercept)
if comm.rank == 0:
    print(f"F  = {F:8.3f} N,   given {force:8.3f}, {problem.report.products['total']} products")
    print(f"a  = {1e3 * a_fit:8.4f} mm,  Hertz {1e3 * a:8.4f}  {a_fit / a - 1:+.2%}")
    print(f"p0 = {1e-6 * p0_fit:8.3f} MPa, Hertz {1e-6 * p0:8.3f}  {p0_fit / p0 - 1:+.2%}")

line = np.linspace(0, a, 400)
draw_profile(
    Path("results") / "axisymmetric_ball_pressure.png",
    {
        "nodes": (1e3 * radii, 1e-6 * p, "o"),
        "Hertz": (1e3 * line, 1e-6 * p0 * np.sqrt(1 - (line / a) ** 2), "-"),
    },
    xlabel="distance from the axis [mm]",
    ylabel="normal pressure [MPa]",
    title="Ball on a rigid plane, computed in the plane of a meridian",
)
