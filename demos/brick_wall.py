"""A dry wall of bricks under a horizontal load: how far it can be pushed before it slides.

# Brick wall

Bricks of 240 x 120 mm lie in running bond on the ground, without mortar. Each is a body of its own;
friction acts in all bed joints, head joints and on the ground. A pressure on the top holds the wall
down, and a horizontal traction pushes its top. No displacement is prescribed.

The wall is pushed until friction cannot hold it and its upper course slides. Whether it can is
decided with rigid bricks, before any stiffness matrix is factored; the error names the bricks that
slide or turn, and how much friction it would take.

This demo illustrates how to

- find the contact pairs of many bodies, without tags, and give them friction;
- increase a load step by step, with slips that stay;
- catch the error for a load that friction cannot hold.

Run it by `python demos/brick_wall.py`; it draws pictures into `results/`. Other pushes, such as
0.33 0.36, may be given. All units are SI; forces are per metre of the wall's thickness.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import (
    ContactProblem,
    Coulomb,
    Plane,
    RigidObstacle,
    UnresistedMotion,
    find_contacts,
)
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
)
from fenics_tfeti.models import isotropic

results = Path("results")

# ## Bricks
#
# Every other course begins and ends with half a brick.

length, height, courses, bricks_per_course = 0.24, 0.12, 4, 2
bricks = []
for course in range(courses):
    ends = np.arange(bricks_per_course + 1) * length
    if course % 2:
        ends = np.concatenate([[0.0], ends[:-1] + length / 2, [ends[-1]]])
    for left, right in zip(ends[:-1], ends[1:], strict=True):
        bricks.append((left, right, course * height))

half = length / 2
parts = [
    Box((left, low), (right, low + height), (4 * round((right - left) / half), 4))
    for left, right, low in bricks
]
wall = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
mesh = wall.mesh

# ## Joints
#
# Two bricks touch where a facet of one is opposite to a facet of the other. Tags are only for the
# ground and for the load on the top.

LOADED, GROUND = 1, 2
at_height = lambda y: lambda x: np.isclose(x[1], y)  # noqa: E731
facet_tags = tag_facets(mesh, {GROUND: at_height(0.0), LOADED: at_height(courses * height)})

friction = Coulomb(0.35)
contacts = find_contacts(mesh, wall.cell_tags, friction=friction)
ground = Plane(point=(0, 0), normal=(0, 1))
contacts.append(RigidObstacle(facet_tags, GROUND, ground, name="ground", friction=friction))

# ## Linear elasticity, plane strain

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(isotropic(5e9, 0.2)(u), ufl.grad(v)) * ufl.dx

weight = fem.Constant(mesh, np.array([0.0, -18e3]))
pressure = 200e3
traction = fem.Constant(mesh, np.array([0.0, -pressure]))
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
L = ufl.inner(weight, v) * ufl.dx + ufl.inner(traction, v) * ds(LOADED)

problem = ContactProblem(
    a, L, bcs=[], contacts=contacts, cell_tags=wall.cell_tags, options={"rtol": 1e-5}
)

# ## Pushed until it gives way

pushes = sys.argv[1:] or [0.0, 0.1, 0.2, 0.25, 0.3, 0.33, 0.36, 0.4]
moved, limit = [], None
for push in map(float, pushes):
    traction.value[0] = push * pressure
    try:
        solution = problem.solve().copy()
        problem.advance()
    except UnresistedMotion as error:
        limit = push
        if mesh.comm.rank == 0:
            print(f"push {push:.2f} of the pressure: {error}")
        break
    uh = solution
    uh.name = "displacement"
    top = mesh.comm.allreduce(float(np.max(uh.x.array.reshape(-1, 2)[:, 0], initial=0)), MPI.MAX)
    moved.append((push, top))
    sticking, nodes = (problem.report.unknowns[key] for key in ("sticking", "friction"))
    if mesh.comm.rank == 0:
        print(
            f"push {push:.2f} of the pressure: moves by {1e6 * top:6.1f} um, "
            f"{sticking} of {nodes} nodes stick"
        )

# The ground carries the load on the top and the weight.

width = bricks_per_course * length
load = np.array([moved[-1][0], -1.0]) * pressure * width
load[1] -= 18e3 * width * courses * height
balance = np.abs(np.array(problem.report.contacts[-1].force) + load).max() / np.abs(load).max()

# ## Pictures

share, top = np.array(moved).T
draw_profile(
    results / "brick_wall_push.png",
    {"top of the wall": (1e6 * top, share, "o-")},
    xlabel="largest displacement [µm]",
    ylabel="horizontal load / vertical load",
    title="Dry wall under a horizontal load",
)
draw_deformed(
    results / "brick_wall.png",
    uh,
    label="displacement",
    unit="mm",
    title=f"Dry wall pushed by {moved[-1][0]:g} of its vertical load",
)
