r"""The crown of a roller that makes its pressure uniform, found by gradients.

# A crown by sensitivities

The roller of `demos/hertz_cylinder.py` is pressed onto a rigid surface whose height s(x) is to be
chosen such that the pressure is uniform on a strip. The heights at ten places are the unknowns of

$$J(s) = \tfrac{1}{2} \sum_i \left(\frac{p_i - \bar p_i}{\bar p}\right)^2,$$

with the mean pressure $\bar p_i = \bar p$ at the nodes up to w = 2 mm from the middle, and zero
beyond.
Each step of SciPy's quasi-Newton method asks for J and its gradient: a contact problem, and one
linear solve with the factors that are there, for all ten derivatives.

This demo illustrates how to

- take derivatives of contact pressures: `problem.adjoint(normal_forces=...)` and `by_gap`;
- optimise with `scipy.optimize.minimize`.

Run it by `python demos/roller_crown.py`; it draws a picture into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.optimize import minimize

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_profile, read_msh
from fenics_tfeti.models import isotropic, small_strain, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## The roller
#
# As in the other demo, a quarter of it, with a load for which Hertz's strip has half of the force
# of a = 3 mm.

R, E, nu, w = 0.05, 2e9, 0.3, 2e-3
force = np.pi * E / (1 - nu**2) * 3e-3**2 / (4 * R) / 2  # of the half

roller = read_msh(here.parent / "meshes" / "hertz_cylinder.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = roller.mesh, roller.facet_tags, roller.names
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(isotropic(E, nu)(u), small_strain(v)) * ufl.dx
L = fem.Constant(mesh, -force / R) * v[1] * ds(tags["flat"])
bcs = [symmetry_plane(V, facet_tags, tags["symmetry_x"], axis=0)]

# ## The surface
#
# Heights at ten places, linear between them, in units of 10 um. The gap to it is the height of a
# node of the roller above it.

places, unit = np.linspace(0.0, 2.25e-3, 10), 1e-5
heights = np.zeros(places.size)


def surface(x):
    gap = x[1] + np.interp(x[0], places, heights)
    return gap, np.stack([np.zeros_like(gap), np.ones_like(gap)])


def contact():
    return RigidObstacle(facet_tags, slave=tags["contact"], obstacle=surface, name="strip")


options = {"rtol": 1e-8, "subdomain_size": 600}
problem = ContactProblem(a, L, bcs=bcs, contacts=[contact()], options=options)

# ## J and its gradient
#
# The derivatives of J by the normal forces are weights for `adjoint`; the gap of a node follows the
# heights beside it. The mean is that over the lengths that belong to the nodes of the strip.

comm = MPI.COMM_WORLD
problem.solve()
strip = problem.results["strip"]
mean = force / comm.allreduce(strip.area[strip.coordinates[:, 0] < w + 1e-9].sum())
products = {"solves": 0, "adjoints": 0}


def pressures():
    strip = problem.results["strip"]
    x, p = strip.coordinates[:, 0], strip.nodal_normal_force / strip.area
    return x, (p - np.where(x < w + 1e-9, mean, 0.0)) / mean


def J_and_gradient(s):
    heights[:] = s * unit
    problem.contacts = [contact()]
    problem.solve()
    x, misfit = pressures()
    area = problem.results["strip"].area
    adjoint = problem.adjoint(normal_forces={"strip": misfit / (area * mean)})
    products["solves"] += problem.report.products["total"]
    products["adjoints"] += adjoint.linear_solves.products
    shares = np.array([np.interp(x, places, e) for e in np.eye(places.size)])
    J = comm.allreduce(0.5 * misfit @ misfit)
    return J, unit * comm.allreduce(shares @ adjoint.by_gap("strip"))


def profile():
    nodes = problem.results["strip"].gather()
    return 1e3 * nodes.coordinates[:, 0], nodes.pressure / 1e6


# ## The crown

first, _ = J_and_gradient(np.zeros(places.size))
before = profile()
found = minimize(
    J_and_gradient, np.zeros(places.size), jac=True, method="L-BFGS-B", options={"maxiter": 100}
)
last, _ = J_and_gradient(found.x)
x, misfit = pressures()
worst = comm.allreduce(np.abs(misfit[x < 0.95 * w]).max(initial=0.0), MPI.MAX)
if comm.rank == 0:
    print(f"J from {first:.3f} to {last:.4f} in {found.nfev} solves and as many adjoints")
    print(f"iterations: {products['solves']} and {products['adjoints']}")
    print(f"pressure on the strip within {worst:.1%} of its mean, {mean / 1e6:.1f} MPa")
    print("crown [um]:", *(f"{height:.1f}" for height in 1e6 * heights))

draw_profile(
    results / "roller_crown.png",
    {"flat surface": (*before, "o-"), "with crown": (*profile(), "s-")},
    xlabel="distance from the middle [mm]",
    ylabel="normal pressure [MPa]",
    title="Roller on a flat surface, and on one with a crown",
)
