r"""A ball on a plane, loaded and unloaded in steps: one problem, solved for each load.

# Load steps

The ball of `demos/hertz_ball.py` is pressed onto the rigid plane by a force F that grows in three
steps and then decreases. By Hertz's formula, the radius a of the contact area is

$$a^3 = \frac{3 F R}{4 E^*}.$$

Without friction the solution depends on the present load only: loading and unloading give the same
contact area for the same force.

This demo illustrates how to

- change the load of a problem and solve it again;
- reuse what the load does not change: later steps take the factors and the coarse problem of the
  first step, and their iterations start from the contact forces of the step before;
- compare with a new `ContactProblem` for each step.

Run it by `python demos/load_steps.py`, or on several processes by
`mpirun -n 2 python demos/load_steps.py`; it draws a picture into `results/`. All units are SI.
"""

from functools import cache
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_profile, read_msh
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## The problem
#
# The same as in `demos/hertz_ball.py`, which explains it. Hertz's formula gives a = 4 mm for the
# largest force. The traction is a `Constant`, so that its value can be changed between the steps.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
largest_force = 4 / 3 * E_star * 4e-3**3 / R

ball = read_msh(here.parent / "meshes" / "hertz_ball_hexahedra.msh", comm)
mesh, facet_tags, tags = ball.mesh, ball.facet_tags, ball.names
traction = fem.Constant(mesh, 0.0)

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx
L = traction * v[2] * ds(tags["flat"])
planes = ("symmetry_x", 0), ("symmetry_y", 1)
bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in planes]

ground = Plane(point=(0, 0, 0), normal=(0, 0, 1))
contact = RigidObstacle(facet_tags, slave=tags["contact"], obstacle=ground)


def new_problem():
    """Return the problem, not solved."""
    return ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"rtol": 1e-6})


# ## Results of a step
#
# The contact force is four times that of the quarter. The radius of the contact area is fitted as
# in `demos/hertz_ball.py`: by Hertz's formula, p^2 is a linear function of r^2.


def force_and_radius(problem):
    """Return the contact force and the fitted radius of the contact area."""
    found = problem.results[0].gather()
    r, p = np.linalg.norm(found.coordinates[:, :2], axis=1), found.pressure
    inner = p > 0.3 * p.max()
    slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
    return 4 * problem.report.contacts[0].normal_force, np.sqrt(-intercept / slope)


def tell(line):
    """Print on one rank."""
    if comm.rank == 0:
        print(line, flush=True)


# ## Steps
#
# The same `problem` is solved again after each change of `traction`, and compared with a new
# problem for each load. Sums of products and times leave out the first step, which can
# reuse nothing.


@cache
def from_scratch(load):
    """Return displacement and report of a new problem."""
    problem = new_problem()
    traction.value = load
    return problem.solve(), problem.report


loading, unloading = [1 / 4, 2 / 4, 4 / 4], [2 / 4]
problem = new_problem()
forces, radii, costs, differences = [], [], [], []
for fraction in loading + unloading:
    traction.value = load = -fraction * largest_force / (np.pi * R**2)
    uh = problem.solve()
    F, radius = force_and_radius(problem)
    forces.append(F)
    radii.append(radius)
    cold_uh, cold = from_scratch(load)
    largest = max(comm.allgather(np.abs(uh.x.array - cold_uh.x.array).max()))
    differences.append(largest / max(comm.allgather(np.abs(uh.x.array).max())))
    reports = problem.report, cold
    costs.append([(report.products["total"], report.seconds["total"]) for report in reports])
    error = radius / (3 * F * R / (4 * E_star)) ** (1 / 3) - 1
    tell(f"{F:8.2f} N: radius {1e3 * radius:.4f} mm ({error:+.2%} to Hertz)")

(again, again_seconds), (scratch, scratch_seconds) = np.sum(costs[1:], axis=0)
tell(f"after the first step: {again:.0f} iterations, {again_seconds:.2f} s")
tell(f"from scratch:         {scratch:.0f} iterations, {scratch_seconds:.2f} s")
tell(f"reused from the step before: {', '.join(problem.report.reused)}")

# For the same force the radius is the same in loading and in unloading.

n = len(loading)
difference = abs(radii[n] / radii[1] - 1)
tell(f"half the force, in loading and unloading: the radii differ by {difference:.1e}")

# ## Picture

curve = np.linspace(0, max(radii), 400)
draw_profile(
    results / "load_steps.png",
    {
        "Hertz": (1e-3 * 4 / 3 * E_star * curve**3 / R, 1e3 * curve, "-"),
        "loading": (1e-3 * np.array(forces[:n]), 1e3 * np.array(radii[:n]), "o"),
        "unloading": (1e-3 * np.array(forces[n:]), 1e3 * np.array(radii[n:]), "x"),
    },
    xlabel="force [kN]",
    ylabel="radius of the contact area [mm]",
    title="Ball on a rigid plane, loaded in three steps and unloaded",
)
