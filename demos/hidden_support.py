r"""The clearance and the stiffness of a support that cannot be reached, from measured deflections.

# A hidden support

A cantilever ends above a block of rubber, with a clearance. Neither the clearance nor the stiffness
of the block is known. The deflection of the beam's top was measured under two loads, with an error
of some micrometres. Sought are the clearance c and Young's modulus E of the block that minimise the
misfit

$$J(c, \log E) = \tfrac{1}{2} \sum_\text{loads} \int_\text{top}
  (u_y - u_\text{measured})^2 \, ds.$$

Each step of SciPy's quasi-Newton method asks for J and its gradient: for each load a contact
problem, and one linear solve with the factors that are there, for both derivatives.

This demo illustrates how to

- take derivatives by gaps and by a material at once: `by_gap` and `by`;
- identify data of a model by `scipy.optimize.minimize`.

Run it by `python demos/hidden_support.py`; it draws a picture into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.optimize import minimize

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic, small_strain

results = Path("results")

# ## The beam and the block
#
# Both are drawn with their surfaces at one place: the clearance is a prescribed gap.

BEAM, BLOCK, CLAMPED, TOP, BELOW, ON_BLOCK, GROUND = range(1, 8)
length, height, start = 0.4, 0.02, 0.3  # of the beam; where the block begins
parts = [
    Box((0.0, 0.0), (length, height), divisions=(80, 4), name="beam"),
    Box((start, -0.04), (length, 0.0), divisions=(20, 8), name="block"),
]
bodies = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
mesh, comm = bodies.mesh, bodies.mesh.comm
facet_tags = tag_facets(
    mesh,
    [
        (CLAMPED, lambda x: np.isclose(x[0], 0.0), BEAM),
        (TOP, lambda x: np.isclose(x[1], height), BEAM),
        (BELOW, lambda x: np.isclose(x[1], 0.0) & (x[0] > start - 1e-9), BEAM),
        (ON_BLOCK, lambda x: np.isclose(x[1], 0.0), BLOCK),
        (GROUND, lambda x: np.isclose(x[1], -0.04), BLOCK),
    ],
    bodies.cell_tags,
)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=mesh, subdomain_data=bodies.cell_tags)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)

E, pressure = fem.Constant(mesh, 3e6), fem.Constant(mesh, 0.0)  # of the block; on the top
a = ufl.inner(isotropic(7e10, 0.33)(u), small_strain(v)) * dx(BEAM)
a += ufl.inner(isotropic(E, 0.45)(u), small_strain(v)) * dx(BLOCK)
L = -pressure * v[1] * ds(TOP)
still = np.zeros(2)
bcs = [
    fem.dirichletbc(still, fem.locate_dofs_topological(V, 1, facet_tags.find(tag)), V)
    for tag in (CLAMPED, GROUND)
]

loads = 2e4, 6e4  # the pressures


def contact(clearance):
    names = {"slave": BELOW, "master": ON_BLOCK, "name": "support"}
    return ContactPair(facet_tags, **names, initial_gap=clearance)


problem = ContactProblem(
    a, L, bcs=bcs, contacts=[contact(0.0)], cell_tags=bodies.cell_tags, options={"rtol": 1e-8}
)


def solve(values, load):
    """Solve for a clearance [mm] and the logarithm of E over 3 MPa, under a load."""
    E.value, pressure.value = 3e6 * np.exp(values[1]), load
    problem.contacts = [contact(1e-3 * values[0])]
    return problem.solve()


# ## The measurements
#
# They are those of a block with E = 1 MPa and a clearance of 0.7 mm, with errors of 3 um added.

true = np.array([0.7, np.log(1 / 3)])
measured, random = [], np.random.default_rng(7)
for load in loads:
    noisy = fem.Function(V)
    noisy.x.array[:] = solve(true, load).x.array
    noisy.x.array[:] += 3e-6 * random.standard_normal(noisy.x.array.size)
    noisy.x.scatter_forward()
    measured.append(noisy)

# ## J and its gradient
#
# J is in units of the square of a micrometre, as a mean over the top.

target = fem.Function(V)
misfit = 0.5 * (problem.u[1] - target[1]) ** 2 * ds(TOP)
unit = 1e-12 * length


def J_and_gradient(values):
    J, gradient = 0.0, np.zeros(2)
    for load, observed in zip(loads, measured, strict=True):
        solve(values, load)
        target.x.array[:] = observed.x.array
        J += comm.allreduce(fem.assemble_scalar(fem.form(misfit))) / unit
        adjoint = problem.adjoint(misfit)
        gradient[0] += 1e-3 * comm.allreduce(adjoint.by_gap("support").sum()) / unit
        gradient[1] += float(adjoint.by(E)) * float(E.value) / unit
    return J, gradient


# ## The search
#
# It begins with a block of 3 MPa without clearance.

guess = np.zeros(2)
first, _ = J_and_gradient(guess)
found = minimize(J_and_gradient, guess, jac=True, method="L-BFGS-B", options={"ftol": 1e-6})
last, clearance, modulus = found.fun, found.x[0], 3 * np.exp(found.x[1])
if comm.rank == 0:
    print(f"root of J from {np.sqrt(first):.0f} to {np.sqrt(last):.1f} um")
    print(f"in {2 * found.nfev} solves and as many adjoints")
    print(f"clearance {clearance:.3f} mm, of 0.700 mm")
    print(f"Young's modulus {modulus:.3f} MPa, of 1.000 MPa")


# ## The deflection of the top


def deflection(function):
    """Return places [mm] and deflections [mm] of the top on this rank."""
    dofs = fem.locate_dofs_topological(V, 1, facet_tags.find(TOP))
    x = V.tabulate_dof_coordinates()[dofs, 0]
    order = np.argsort(x)
    return 1e3 * x[order], 1e3 * function.x.array.reshape(-1, 2)[dofs[order], 1]


curves = {}
for load, observed in zip(loads, measured, strict=True):
    name = f"{load / 1e3:.0f} kPa"
    curves[f"measured, {name}"] = (*deflection(observed), "o")
    curves[f"first guess, {name}"] = (*deflection(solve(guess, load)), "--")
    curves[f"found, {name}"] = (*deflection(solve(found.x, load)), "-")
draw_profile(
    results / "hidden_support.png",
    curves,
    xlabel="distance from the clamped end [mm]",
    ylabel="deflection of the top [mm]",
    title="A support found from measured deflections",
)
