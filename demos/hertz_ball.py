r"""An elastic ball on a rigid plane: the contact problem that Heinrich Hertz solved in 1881.

# Hertz's ball

A ball of radius R = 50 mm is pressed onto a rigid plane without friction. The contact area is a
disc of radius a. Formulas that hold for a much smaller than R are

$$a^3 = \frac{3 F R}{4 E^*}, \quad p(r) = p_0 \sqrt{1 - r^2 / a^2}, \quad
p_0 = \frac{3 F}{2 \pi a^2},$$

where F is the force and $E^* = E / (1 - \nu^2)$ for a rigid plane.

This demo illustrates how to

- define contact with a rigid obstacle, which needs no mesh;
- use symmetry: only a quarter of the lower half of the ball is meshed;
- solve a *semicoercive* problem: a force presses the ball, and contact alone supports it;
- compare the contact pressure with a formula, on hexahedra and on tetrahedra.

Run it by `python demos/hertz_ball.py`, or on several processes by
`mpirun -n 2 python demos/hertz_ball.py`; it draws pictures into `results/`. The meshes come from
`meshes/half_balls.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# A hard plastic. Hertz's formula gives a = 4 mm for this force.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
force = 4 / 3 * E_star * 4e-3**3 / R


# ## One solution
#
# The ball touches the plane at the origin. A traction on the flat face at z = R makes the force.


def solve(path):
    """Solve on the mesh of a file; return the problem, the displacement and the stress."""
    ball = read_msh(path, comm)
    mesh, facet_tags, tags = ball.mesh, ball.facet_tags, ball.names
    sigma = isotropic(E, nu)
    traction = fem.Constant(mesh, -force / (np.pi * R**2))

    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
    L = traction * v[2] * ds(tags["flat"])

    planes = ("symmetry_x", 0), ("symmetry_y", 1)
    bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in planes]
    ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))
    contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=ground)
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-6})
    uh = problem.solve()
    return problem, uh, von_mises(mesh, sigma(uh))


# ## Comparison with Hertz
#
# The formulas are evaluated for the computed contact force, four times that of the quarter. It is
# slightly smaller than the given force, since the flat face of the mesh is a polygon in the circle.
# By Hertz's formula, p^2 is a linear function of r^2. A straight line through the nodes with more
# than 30 % of the largest pressure gives a and p0.


def fit(r, p):
    """Return the radius and the largest pressure fitted to the pressures of the nodes."""
    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
    return np.sqrt(-intercept / slope), np.sqrt(intercept)


curves, errors = {}, {}
for cells, style in (("tetrahedra", "^"), ("hexahedra", "o")):
    problem, uh, stress = solve(here.parent / "meshes" / f"hertz_ball_{cells}.msh")
    contact = problem.results[0].gather()
    r, p = np.linalg.norm(contact.coordinates[:, :2], axis=1), contact.pressure
    F = 4 * problem.report.contacts[0].normal_force
    a = (3 * F * R / (4 * E_star)) ** (1 / 3)
    p0 = 3 * F / (2 * np.pi * a**2)
    a_fit, p0_fit = fit(r, p)
    errors[cells] = a_fit / a - 1, p0_fit / p0 - 1
    curves[cells] = (1e3 * r, 1e-6 * p, style)
    if comm.rank == 0:
        products = problem.report.products["total"]
        print(f"{cells}: force {F:.2f} N, given {force:.2f} N, {products} iterations")
        print(f"  a  = {1e3 * a_fit:8.4f} mm,  Hertz {1e3 * a:8.4f}  {errors[cells][0]:+.2%}")
        print(f"  p0 = {1e-6 * p0_fit:8.3f} MPa, Hertz {1e-6 * p0:8.3f}  {errors[cells][1]:+.2%}")
radius = np.linspace(0, 1.5 * a, 400)
pressure = p0 * np.sqrt(np.maximum(0, 1 - (radius / a) ** 2))
curves["Hertz"] = (1e3 * radius, 1e-6 * pressure, "-")

# ## Pictures

draw_profile(
    results / "hertz_ball_pressure.png",
    curves,
    xlabel="distance from the axis [mm]",
    ylabel="normal pressure [MPa]",
    title="Ball on a rigid plane: contact pressure of all nodes",
)
draw_deformed(
    results / "hertz_ball.png",
    uh,
    stress,
    label="von Mises stress",
    unit="MPa",
    title="A quarter of half a ball, pressed onto a rigid plane",
    scale=1,
    camera=(-1.0, -1.3, -0.2),
)
