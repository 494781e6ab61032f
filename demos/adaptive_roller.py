r"""A rigid roller pressed into a block, on meshes that follow the error of the mesh.

# Meshes that follow the error

A solution by finite elements has two errors: that which the iterations leave, whose bound is in
every report, and that of the mesh, which is usually much larger. `mesh_error` estimates it, cell by
cell, and `adapt` refines the mesh where it is large until it is small enough.

A rigid roller is pressed into an elastic block, in plane strain; by symmetry half of it is meshed.
The error is concentrated at the contact and at its end. Meshes that are refined there need several
times fewer unknowns than uniform ones.

This demo illustrates how to

- estimate the error of the mesh;
- refine a mesh until the error is 5 %;
- draw where the error is.

Run it by `python demos/adaptive_roller.py`, or on several processes by
`mpirun -n 2 python demos/adaptive_roller.py`; it draws pictures into `results/`. All units are SI.
"""

from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidObstacle, Sphere, adapt
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    refine,
    tag_facets,
)
from fenics_tfeti.models import isotropic, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# A block of 40 mm x 20 mm of hard plastic; the roller is pressed 0.5 mm into it.

R, E, nu = 0.05, 2e9, 0.3
size, depth = 0.02, 5e-4
TOP, BOTTOM, SYMMETRY = 1, 2, 3

# ## The first mesh
#
# 4 x 4 squares, each cut into two triangles. `refine` keeps the tags of cells and facets.

block = boxes(comm, [Box((0.0, -size), (size, 0.0), (4, 4), "block")], "triangle")
marks = {
    TOP: lambda x: np.isclose(x[1], 0.0),
    BOTTOM: lambda x: np.isclose(x[1], -size),
    SYMMETRY: lambda x: np.isclose(x[0], 0.0),
}
block = replace(block, facet_tags=tag_facets(block.mesh, marks))


# ## The problem on a mesh
#
# The horizontal displacement is zero on the plane of symmetry. The bottom of the block is moved up;
# the roller stays in place. `Sphere` is a disc in two dimensions.


def problem_on(tagged, degree=1):
    """Return the problem on a mesh with tags."""
    V = displacement_space(tagged.mesh, degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx
    bottom = fem.locate_dofs_topological(V.sub(1), 1, tagged.facet_tags.find(BOTTOM))
    bcs = [
        symmetry_plane(V, tagged.facet_tags, SYMMETRY, axis=0),
        fem.dirichletbc(depth, bottom, V.sub(1)),
    ]
    roller = RigidObstacle(
        tagged.facet_tags, slave=TOP, obstacle=Sphere(centre=(0, R), radius=R), name="rigid roller"
    )
    return ContactProblem(a, 0, bcs=bcs, contacts=[roller])


# ## Adapted meshes
#
# `adapt` prints a line for each mesh. Each solve starts from the contact of the mesh before.

curves, found = {}, {}
for degree in (1, 2):
    if comm.rank == 0:
        print(f"Displacements of degree {degree}")
    found[degree] = adapt(
        lambda mesh, degree=degree: problem_on(mesh, degree), block, error=0.05, print_progress=True
    )
    levels = found[degree].levels
    unknowns, errors = zip(*((level.unknowns, 100 * level.error) for level in levels), strict=True)
    curves[f"adapted, degree {degree}"] = (np.log10(unknowns), np.log10(errors), "o-")
problem, estimate, _ = found[1]

# ## Uniform meshes
#
# All cells are refined.

for degree in (1, 2):
    uniform, points = block, []
    for _ in range(4 if degree == 1 else 3):
        other = problem_on(uniform, degree)
        other.solve()
        points.append((other.report.unknowns["primal"], 100 * other.mesh_error().error))
        uniform = refine(uniform)
    unknowns, errors = np.log10(points).T
    curves[f"uniform, degree {degree}"] = (unknowns, errors, "s--")
    if comm.rank == 0:
        last = points[-1]
        print(f"Uniform, degree {degree}: {last[0]} unknowns, error about {last[1]:.2g} %")

# ## Report and pictures
#
# The report has the error once `mesh_error` was called.

if comm.rank == 0:
    print(problem.report)
draw_deformed(
    results / "adaptive_roller.png",
    problem.u,
    estimate.density,
    label="density of the error (log10)",
    title="Where the error of the mesh is, at 5 % in all",
)
draw_profile(
    results / "adaptive_roller_convergence.png",
    curves,
    xlabel="log10 of the number of unknowns",
    ylabel="log10 of the error [%]",
    title="Error of the mesh: adapted and uniform meshes",
)
