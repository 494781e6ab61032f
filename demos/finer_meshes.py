r"""A rigid roller pressed into a block, on finer and finer meshes: each starts from the one before.

# Finer meshes

A study of mesh convergence solves one problem on several meshes. The solution on a coarse mesh is
also a good start for the solver on a finer one: it predicts which nodes are in contact, and the
contact forces there.

A rigid roller of radius R is pressed into an elastic block, in plane strain; by symmetry half of it
is meshed. Hertz's formulas for a half space give approximately the half-width a of the contact area
and the largest pressure p0,

$$a^2 = \frac{4 F R}{\pi E^*}, \quad p_0 = \frac{2 F}{\pi a},$$

where F is the force per unit length and $E^* = E / (1 - \nu^2)$.

This demo illustrates how to

- make structured meshes of one body;
- start from the solution on a coarser mesh, by `solve(coarse=...)`;
- measure what that saves: the problem on each mesh is solved without it as well.

Run it by `python demos/finer_meshes.py`, or on several processes by
`mpirun -n 2 python demos/finer_meshes.py`; it draws a picture into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidObstacle, Sphere
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# A block of 40 mm x 20 mm of hard plastic; the roller is pressed 0.5 mm into it.

R, E, nu = 0.05, 2e9, 0.3
E_star = E / (1 - nu**2)
size, depth = 0.02, 5e-4
TOP, BOTTOM, SYMMETRY = 1, 2, 3


# ## One problem
#
# The horizontal displacement is zero on the plane of symmetry. The bottom of the block is moved up;
# the roller stays in place. `Sphere` is a disc in two dimensions.


def new_problem(n):
    """Return the problem on a mesh of n x n squares."""
    mesh = boxes(comm, [Box((0.0, -size), (size, 0.0), (n, n))], "quadrilateral").mesh
    facet_tags = tag_facets(
        mesh,
        [
            (TOP, lambda x: np.isclose(x[1], 0.0)),
            (BOTTOM, lambda x: np.isclose(x[1], -size)),
            (SYMMETRY, lambda x: np.isclose(x[0], 0.0)),
        ],
    )
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx
    bottom = fem.locate_dofs_topological(V.sub(1), 1, facet_tags.find(BOTTOM))
    bcs = [
        symmetry_plane(V, facet_tags, SYMMETRY, axis=0),
        fem.dirichletbc(depth, bottom, V.sub(1)),
    ]
    roller = RigidObstacle(facet_tags, slave=TOP, obstacle=Sphere(centre=(0, R), radius=R))
    return ContactProblem(a, 0, bcs=bcs, contacts=[roller])


def effort(report):
    """Format iterations, applications of the preconditioner, and active sets."""
    products = report.products
    return f"{products['total']:3d} + {products['preconditioner']:3d}, sets: {len(report.faces)}"


# ## Four meshes
#
# `solve` takes the solved problem of the coarser mesh, with its contact and its displacement.

curves, coarse = {}, None
for n in (16, 32, 64, 128):
    problem = new_problem(n)
    problem.solve(coarse=coarse)
    alone = new_problem(n)
    alone.solve()

    force = 2 * problem.report.contacts[0].normal_force
    a = np.sqrt(4 * force * R / (np.pi * E_star))
    contact = problem.results[0].gather()
    x = contact.coordinates[:, 0]
    if comm.rank == 0:
        print(
            f"{problem.report.unknowns['primal']:6d} unknowns: F = {1e-3 * force:.1f} kN/m, "
            f"half-width {1e3 * x[contact.active].max():.2f} mm, Hertz {1e3 * a:.2f} mm"
        )
        print(f"       from zero            {effort(alone.report)}")
        if coarse:
            print(f"       from the coarse mesh {effort(problem.report)}")
    curves[f"{n} x {n}"] = (1e3 * x, 1e-6 * contact.pressure, "sDo^"[len(curves)])
    coarse = problem

# ## Picture
#
# By Hertz's formula the pressure is p0 sqrt(1 - x^2 / a^2).

p0 = 2 * force / (np.pi * a)
axis = np.linspace(0, 1.5 * a, 300)
hertz = p0 * np.sqrt(np.maximum(0, 1 - (axis / a) ** 2))
near = {label: (x[x < 1.5e3 * a], p[x < 1.5e3 * a], s) for label, (x, p, s) in curves.items()}
draw_profile(
    results / "finer_meshes.png",
    {**near, "Hertz, half space": (1e3 * axis, 1e-6 * hertz, "-")},
    xlabel="distance from the plane of symmetry [mm]",
    ylabel="normal pressure [MPa]",
    title="Rigid roller in a block: contact pressure on four meshes",
)
