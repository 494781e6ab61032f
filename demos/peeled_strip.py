"""A strip that is peeled off a plate at one of its corners: the front of the crack.

# Peeled strip

A strip of plastic, 30 x 10 x 1 mm, is glued on a rigid plate. One of its corners is lifted. The
glue holds up to 0.7 MPa, and its failure takes 0.05 N/mm along and across the plate.

The glue is a `Cohesive` bond between the strip and a rigid obstacle. Where it has failed there is
contact: the strip can come back to the plate, not below it. The front of the crack starts around
the corner, and runs across the strip when it has come to its other side.

The force rises with the length of the front, and falls once that is as wide as the strip. The
solver walks along equilibria that each take the same energy to the height of a load step.

This demo illustrates how to

- glue a body on an obstacle;
- draw the damage of the bond, seen through the plate;
- check the energy that the glue has taken: it is the work of the force without what is stored.

Run it by `python demos/peeled_strip.py`, or on several processes by
`mpirun -n 2 python demos/peeled_strip.py`; it draws pictures into `results/`. The number of load
steps may be given. Units are mm, N and MPa.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import Cohesive, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import (
    Box,
    boxes,
    contact_fields,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
)
from fenics_tfeti.models import isotropic

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data and mesh

E, nu = 3000.0, 0.35
length, width, thickness = 30.0, 10.0, 1.0
strength, energy = 0.7, 0.05
(number,) = map(int, sys.argv[1:] or (10,))
heights = 0.1 * np.arange(1, 1 + number)

strip = boxes(comm, [Box((0, 0, 0), (length, width, thickness), (45, 15, 2))], "hexahedron")
tags = tag_facets(strip.mesh, [(1, lambda x: np.isclose(x[2], 0))])

# ## Problem
#
# The upper corner at the origin is lifted; its other displacements are free.

V = displacement_space(strip.mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
sigma = isotropic(E, nu)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
vertical = V.sub(2).collapse()[0]
lift = fem.Function(vertical)
corner = fem.locate_dofs_geometrical(
    (V.sub(2), vertical),
    lambda x: np.isclose(x[0], 0) & np.isclose(x[1], 0) & np.isclose(x[2], thickness),
)
plate = Plane(point=(0, 0, 0), normal=(0, 0, 1))
glue = RigidObstacle(tags, 1, plate, law=Cohesive(strength, energy), name="glue")
problem = ContactProblem(
    a,
    0,
    bcs=[fem.dirichletbc(lift, corner, V.sub(2))],
    contacts=glue,
    options={"units": "mm-N-MPa", "rtol": 1e-4},
)


def tell(line):
    """Print on one rank."""
    if comm.rank == 0:
        print(line, flush=True)


# ## Lifting
#
# Of each load step all equilibria on the way are drawn. The work of the force is summed along them,
# by chords.

curve, spent = [(0.0, 0.0)], 0.0
for height in heights:
    lift.x.array[:] = height
    problem.solve()
    damage = problem.report.damage
    curve += [(step.factor * height, step.reactions[0][2]) for step in damage.path]
    spent += damage.dissipated["glue"]
    problem.advance()
    tell(
        f"{height:.1f} mm: {curve[-1][1]:.3f} N, {damage.failed['glue']:3d} bonds failed, "
        f"{spent:.3f} mJ; {damage.passes:2d} solves, {damage.products} products"
    )

z, F = np.array(curve).T
work = 0.5 * np.sum((F[1:] + F[:-1]) * np.diff(z))
stored = 0.5 * F[-1] * z[-1]
tell(f"work {work:.3f} mJ, of which {stored:.3f} mJ are stored and {spent:.3f} mJ in the glue")

# ## Pictures

draw_profile(
    results / "peeled_strip_force.png",
    {"lifted corner": (z, F, ".-")},
    xlabel="height of the corner [mm]",
    ylabel="force [N]",
    title="A strip that is peeled off a plate",
)
damage_of_glue = contact_fields(V, problem.results).damage
for name, camera in (("above", (-1.0, -1.0, 0.6)), ("below", (-0.6, -0.8, -1.2))):
    draw_deformed(
        results / f"peeled_strip_{name}.png",
        problem.u,
        damage_of_glue,
        title=f"Damage of the glue, seen from {name}; the corner at {heights[-1]:.1f} mm",
        units="mm-N-MPa",
        camera=camera,
        scale=3,
    )
