"""A ball on a plane, pressed in steps and let go: solve once, then again and again.

# Load steps

The ball of `demos/hertz_ball.py` is pressed onto the rigid plane by a force F that grows in eight
steps, and then is let go in three. The disc of contact grows as Hertz's formula says,

    a^3 = 3 F R / (4 E*).

Without friction, only the present force matters: on the way back the contact is what it was on the
way there.

This demo illustrates how to

- change the load of a problem and solve it again;
- see what that saves: factors and coarse problem are those of the first step, and the iterations
  start from the last contact forces. A new `ContactProblem` solves each step as well, to compare.

Run it by `python demos/load_steps.py`, or on several processes by
`mpirun -n 2 python demos/load_steps.py`; it draws a picture into `results/`. All units are SI.
"""

from __future__ import annotations

import time
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_profile, read_msh

here = Path(__file__).parent
results = here.parent / "results"
comm = MPI.COMM_WORLD

# ## The problem
#
# As in `demos/hertz_ball.py`; there is more about it there. The largest force is the one for which
# Hertz's formula says a = 4 mm. The traction is a constant, so that its value can be changed.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
largest_force = 4 / 3 * E_star * 4e-3**3 / R

ball = read_msh(here.parent / "meshes" / "hertz_ball_hexahedra.msh", comm)
mesh, facet_tags, tags = ball.mesh, ball.facet_tags, ball.names
mu = fem.Constant(mesh, E / (2 * (1 + nu)))
lmbda = fem.Constant(mesh, E * nu / ((1 + nu) * (1 - 2 * nu)))
traction = fem.Constant(mesh, 0.0)


def epsilon(u):
    """Return the small strain."""
    return ufl.sym(ufl.grad(u))


def sigma(u):
    """Return the stress [Pa]."""
    return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(3) + 2 * mu * epsilon(u)


V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(sigma(u), epsilon(v)) * ufl.dx
L = traction * v[2] * ds(tags["flat"])
bcs = []
for component, plane in ((0, "symmetry_x"), (1, "symmetry_y")):
    Vi = V.sub(component)
    dofs = fem.locate_dofs_topological(Vi, 2, facet_tags.find(tags[plane]))
    bcs.append(fem.dirichletbc(0.0, dofs, Vi))

ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))
contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=ground)


def new_problem():
    """Return the problem, not solved."""
    return ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-6})


# ## What to look at
#
# The force that the solution transmits, four times that of the quarter, and the radius of the disc
# of contact, from the straight line that p^2 is over r^2 by Hertz, as in `demos/hertz_ball.py`.


def force_and_radius(problem):
    """Return the force and the fitted radius of the disc of contact."""
    found = problem.contact[0].gather()
    r, p = np.linalg.norm(found.coordinates[:, :2], axis=1), found.pressure
    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
    return 4 * problem.report.contact_force[0], np.sqrt(-intercept / slope)


def timed(work):
    """Return what a function returns, and the seconds that it took on the slowest rank."""
    comm.barrier()
    start = time.perf_counter()
    result = work()
    return result, comm.allreduce(time.perf_counter() - start, MPI.MAX)


def tell(line):
    """Print on one rank."""
    if comm.rank == 0:
        print(line, flush=True)


# ## Steps
#
# The same `problem` is solved again after each change of `traction`. The first step costs what any
# solution costs, and is left out of the sums. (The forms are compiled before anything is timed:
# later solves find them in the cache.)

new_problem()
fractions = [*np.arange(1, 9) / 8, 6 / 8, 3 / 8, 1 / 8]
problem, setup = timed(new_problem)
forces, radii, costs = [], [], []
tell("          --- force ---  ----- radius -----  --- solved again ---  ---- from scratch ---")
tell("  step         N  of all        mm  to Hertz  products    seconds  products      seconds")
for step, fraction in enumerate(fractions):
    traction.value = -fraction * largest_force / (np.pi * R**2)
    uh, seconds = timed(problem.solve)
    products = problem.report.products["total"]
    F, radius = force_and_radius(problem)
    forces.append(F)
    radii.append(radius)

    cold, cold_setup = timed(new_problem)
    cold_uh, cold_seconds = timed(cold.solve)
    difference = np.abs(uh.x.array - cold_uh.x.array).max() / np.abs(cold_uh.x.array).max()
    if comm.allreduce(difference, MPI.MAX) > 1e-5:
        raise RuntimeError(f"step {step}: solved again and solved from scratch differ")
    cost = (
        products,
        seconds + (setup if step == 0 else 0.0),
        cold.report.products["total"],
        cold_setup + cold_seconds,
    )
    costs.append(cost)
    error = 100 * (radius / (3 * F * R / (4 * E_star)) ** (1 / 3) - 1)
    tell(
        f"  {step:4d} {F:9.2f} {fraction:7.3f} {1e3 * radius:9.4f} {error:+7.2f} % "
        f"{cost[0]:9d} {cost[1]:10.2f} {cost[2]:9d} {cost[3]:12.2f}"
    )

again, again_seconds, scratch, scratch_seconds = np.sum(costs[1:], axis=0)
tell(f"all after the first: {again:.0f} instead of {scratch:.0f} products")
tell(
    f"all after the first: {again_seconds:.2f} s instead of {scratch_seconds:.2f} s, "
    f"{scratch_seconds / again_seconds:.1f} times faster"
)
tell(f"taken over from the step before: {', '.join(problem.report.reused)}")

# The way back: the radius for the same force, first when pressed and then when let go.

for step in range(8, len(fractions)):
    before = fractions.index(fractions[step])
    tell(
        f"at {fractions[step]:.3f} of the force: a = {1e3 * radii[before]:.6f} mm pressed, "
        f"{1e3 * radii[step]:.6f} mm let go"
    )

# ## Picture

curve = np.linspace(0, max(radii), 400)
draw_profile(
    results / "load_steps.png",
    {
        "Hertz": (1e-3 * 4 / 3 * E_star * curve**3 / R, 1e3 * curve, "-"),
        "pressed": (1e-3 * np.array(forces[:8]), 1e3 * np.array(radii[:8]), "o"),
        "let go": (1e-3 * np.array(forces[8:]), 1e3 * np.array(radii[8:]), "x"),
    },
    xlabel="force [kN]",
    ylabel="radius of the disc of contact [mm]",
    title="Ball on a rigid plane, pressed in eight steps and let go in three",
    comm=comm,
)
