"""An elastic ball on a rigid plane: the contact problem that Heinrich Hertz solved in 1881.

# Hertz's ball

A ball of radius R = 50 mm is pressed onto a rigid plane without friction. It flattens
over a small disc of radius a. Formulas that hold for a much smaller than R are

    a^3 = 3 F R / (4 E*),   p(r) = p0 sqrt(1 - r^2 / a^2),   p0 = 3 F / (2 pi a^2),

where F is the force and E* = E / (1 - nu^2) for a rigid plane.

This demo illustrates how to

- let a body come into contact with a rigid obstacle, which needs no mesh;
- use symmetry: only a quarter of the lower half of the ball is meshed;
- push with a force: nothing but the plane stops the ball (the problem is *semicoercive*);
- compare the contact pressure with a formula, on hexahedra and on tetrahedra.

Run it by `python demos/hertz_ball.py`, or on several processes by
`mpirun -n 2 python demos/hertz_ball.py`; it writes pictures and fields into `results/`. The meshes
come from `meshes/half_balls.py`. All units are SI.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
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
results = here.parent / "results"
comm = MPI.COMM_WORLD

# ## Data
#
# A hard plastic. The force is the one for which Hertz's formula says a = 4 mm.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
force = 4 / 3 * E_star * 4e-3**3 / R


# ## One solution
#
# Everything up to `ContactProblem` is plain dolfinx. The ball stands on its pole, the origin, and
# its flat cut face at z = R carries the force, as a uniform traction.


def solve(path):
    """Solve on the mesh of a file; return the problem, the displacement and the stress."""
    ball = read_msh(path, comm)
    mesh, facet_tags, tags = ball.mesh, ball.facet_tags, ball.names
    mu = fem.Constant(mesh, E / (2 * (1 + nu)))
    lmbda = fem.Constant(mesh, E * nu / ((1 + nu) * (1 - 2 * nu)))
    traction = fem.Constant(mesh, -force / (np.pi * R**2))

    def epsilon(u):
        return ufl.sym(ufl.grad(u))

    def sigma(u):
        return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(3) + 2 * mu * epsilon(u)

    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    a = ufl.inner(sigma(u), epsilon(v)) * ufl.dx
    L = traction * v[2] * ds(tags["flat"])

    # On a plane of symmetry nothing moves across it.
    bcs = []
    for component, plane in ((0, "symmetry_x"), (1, "symmetry_y")):
        Vi = V.sub(component)
        dofs = fem.locate_dofs_topological(Vi, 2, facet_tags.find(tags[plane]))
        bcs.append(fem.dirichletbc(0.0, dofs, Vi))

    ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))
    contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=ground)
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-6})
    uh = problem.solve()
    return problem, uh, von_mises(mesh, sigma(uh))


# ## Comparison with Hertz
#
# The formulas take the force that the solution transmits, four times that of the quarter. (The mesh
# is a polyhedron, its flat face a bit smaller than the circle. So is the force.) The pressure of a
# node is its contact force over the area that belongs to it. By Hertz, p^2 is a linear function of
# r^2; a straight line through the nodes with more than 30 % of the largest pressure gives a and p0.


def compare(name, problem):
    """Print errors of a and p0; return radii and pressures of the nodes, and Hertz's a and p0."""
    contact = problem.contact[0].gather()
    r, p = np.linalg.norm(contact.coordinates[:, :2], axis=1), contact.pressure
    F = 4 * problem.report.contact_force[0]
    a = (3 * F * R / (4 * E_star)) ** (1 / 3)
    p0 = 3 * F / (2 * np.pi * a**2)

    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
    a_fit, p0_fit = np.sqrt(-intercept / slope), np.sqrt(intercept)
    report = problem.report
    if comm.rank == 0:
        print(f"{name}: {report.unknowns['primal']} unknowns, {report.products['total']} products")
        print(f"  F  = {F:9.2f} N   of the {force:.2f} N that push")
        print(f"  a  = {1e3 * a_fit:9.4f} mm  Hertz {1e3 * a:9.4f}  {100 * (a_fit / a - 1):+.2f} %")
        print(
            f"  p0 = {1e-6 * p0_fit:9.3f} MPa Hertz {1e-6 * p0:9.3f}  "
            f"{100 * (p0_fit / p0 - 1):+.2f} %"
        )
    return r, p, a, p0


curves = {}
for cells in ("tetrahedra", "hexahedra"):
    problem, uh, stress = solve(here.parent / "meshes" / f"hertz_ball_{cells}.msh")
    r, p, a, p0 = compare(cells, problem)
    curves[cells] = (1e3 * r, 1e-6 * p, "^" if cells == "tetrahedra" else "o")
radius = np.linspace(0, 1.5 * a, 400)
hertz = p0 * np.sqrt(np.maximum(0, 1 - (radius / a) ** 2))
curves["Hertz"] = (1e3 * radius, 1e-6 * hertz, "-")

# ## Pictures

write_fields(
    results / "hertz_ball.pvd",
    [uh, stress, *contact_fields(uh.function_space, problem.contact)],
)
problem.report.to_json(results / "hertz_ball.json")
draw_profile(
    results / "hertz_ball_pressure.png",
    curves,
    xlabel="distance from the axis [mm]",
    ylabel="normal pressure [MPa]",
    title="Ball on a rigid plane: contact pressure of all nodes",
    comm=comm,
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
