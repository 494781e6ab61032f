r"""The shape of a punch's foot that makes its pressure uniform, by moving the nodes of the mesh.

# The shape of a punch

A flat punch pressed on a block of the same steel has pressures at its edges that grow without
bound with finer meshes. Which shape s(x) of its foot makes them uniform? The nodes of the punch
move by s(x) at its foot, and by nothing at its top; the heights of s at seven places are the
unknowns of

$$J(s) = \tfrac{1}{2 |A|} \sum_i A_i \left(\frac{p_i - \bar p}{\bar p}\right)^2.$$

One adjoint and `by_mesh()` give the derivatives of J by the coordinates of all nodes, of which
those by the heights are sums.

This demo illustrates how to

- take derivatives by the places of nodes: `by_mesh()`;
- solve again on a mesh that has moved: the problem notices.

Run it by `python demos/punch_shape.py`; it draws a picture into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.optimize import minimize

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Nearest
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic, small_strain, symmetry_plane

results = Path("results")

# ## Half of a punch on half of a block
#
# The punch is drawn a little above the block, so that its nodes are told by their heights.

BLOCK, PUNCH, GROUND, SURFACE, FOOT, TOP, MIDDLE = range(1, 8)
w, height, above, mean = 0.02, 0.03, 1e-5, 100e6
parts = [
    Box((0.0, -0.05), (0.06, 0.0), divisions=(60, 25), name="block"),
    Box((0.0, above), (w, above + height), divisions=(20, 15), name="punch"),
]
bodies = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
mesh, comm = bodies.mesh, bodies.mesh.comm
facet_tags = tag_facets(
    mesh,
    [
        (GROUND, lambda x: np.isclose(x[1], -0.05), BLOCK),
        (SURFACE, lambda x: np.abs(x[1]) < above / 2, BLOCK),
        (FOOT, lambda x: np.abs(x[1] - above) < above / 2, PUNCH),
        (TOP, lambda x: np.isclose(x[1], above + height), PUNCH),
        (MIDDLE, lambda x: np.isclose(x[0], 0.0)),
    ],
    bodies.cell_tags,
)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(isotropic(2.1e11, 0.3)(u), small_strain(v)) * ufl.dx
L = -fem.Constant(mesh, mean) * v[1] * ds(TOP)
bcs = [symmetry_plane(V, facet_tags, tag, axis) for tag, axis in ((GROUND, 1), (MIDDLE, 0))]
joint = ContactPair(facet_tags, slave=FOOT, master=SURFACE, partners=Nearest(), name="joint")
problem = ContactProblem(
    a, L, bcs=bcs, contacts=[joint], cell_tags=bodies.cell_tags, options={"rtol": 1e-8}
)

# ## Moving the nodes
#
# The places are closer to each other where the shape is steep. The middle stays.

places, unit = w * np.array([0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0]), 1e-5
start = mesh.geometry.x.copy()


def shapes(x):
    """Return what nodes at x (n, 3) before all moves rise by with each unknown, (unknowns, n)."""
    foot = [np.interp(x[:, 0], [0.0, *places], [0.0, *e]) for e in np.eye(places.size)]
    fade = np.where(x[:, 1] > above / 2, 1.0 - (x[:, 1] - above) / height, 0.0)
    return unit * np.array(foot) * fade


moves = shapes(start)


def pressures():
    result = problem.results["joint"]
    return result.coordinates[:, 0], result.nodal_normal_force / result.area, result.area


def solve(heights):
    """Solve with a shape of the foot; return J and the adjoint of J."""
    mesh.geometry.x[:, 1] = start[:, 1] + heights @ moves
    problem.solve()
    _, p, area = pressures()
    misfit, total = p / mean - 1.0, comm.allreduce(area.sum())
    adjoint = problem.adjoint(normal_forces={"joint": misfit / (mean * total)})
    return comm.allreduce(0.5 * area @ misfit**2) / total, adjoint


# ## J and its gradient
#
# The nodes of the derivative's space are at their first places now.

flat = np.zeros(places.size)
first, adjoint = solve(flat)
before = pressures()
nodes = adjoint.by_mesh().function_space
owned = nodes.dofmap.index_map.size_local
of_nodes = shapes(nodes.tabulate_dof_coordinates()[:owned])


def J_and_gradient(heights):
    J, adjoint = solve(heights)
    by_y = adjoint.by_mesh().x.array.reshape(-1, 2)[:owned, 1]
    return J, comm.allreduce(of_nodes @ by_y)


found = minimize(J_and_gradient, flat, jac=True, method="L-BFGS-B", options={"maxiter": 40})
last, _ = solve(found.x)
x, p, _ = pressures()
peak = [comm.allreduce(np.max(q / mean, initial=0.0), MPI.MAX) for q in (before[1], p)]
if comm.rank == 0:
    print(f"J from {first:.3f} to {last:.6f} in {found.nfev} solves")
    print(f"largest pressure from {peak[0]:.2f} to {peak[1]:.2f} times the mean")
    print("foot [um]:", *(f"{1e6 * unit * height:.1f}" for height in found.x))

curves = {}
for name, (x, p, _), style in (("flat", before, "o-"), ("with the shape", pressures(), "s-")):
    order = np.argsort(x)
    curves[name] = (1e3 * x[order], p[order] / 1e6, style)
draw_profile(
    results / "punch_shape.png",
    curves,
    xlabel="distance from the middle [mm]",
    ylabel="normal pressure [MPa]",
    title="A flat punch, and one with a shape of its foot",
)
