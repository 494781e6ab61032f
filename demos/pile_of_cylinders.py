"""Three loose cylinders in a trough, under their own weight: contact forces by statics.

# A pile of cylinders

Two plastic cylinders, 0.5 m in diameter, lie on the floor between two rigid walls, and a third one
lies on both. Contact alone supports them.

They are stiff and light: the contact areas are only 0.01 radii wide, and the contact forces differ
by less than 0.1 % from those of rigid discs. With the slope 4/3 of the line of centres and the
weight W, the upper disc presses on each of the lower ones with 5/8 W, and these press on the walls
with 3/8 W and on the floor with 3/2 W.

This demo illustrates how to

- define contact of bodies that touch at a point before they deform: only the surface near this
  point is tagged, since gaps grow with the square of the distance from it;
- give the exact normals of a round surface;
- read the unresisted motions from the report: without friction the upper disc is free to rotate
  about its axis. Forces and stresses are unique, and the smallest displacement is returned;
- check a solution by statics.

The lower discs cannot rotate: where several nodes touch the floor, a rotation would move those on
one side of the centre into it. All normals of the upper disc, the slave, meet in its axis.

Run it by `python demos/pile_of_cylinders.py`, or in three dimensions by
`python demos/pile_of_cylinders.py 3`, where all three cylinders are also free to slide along their
axes; it draws a picture into `results/`. The mesh in three dimensions is coarse: the
weight of the polygons is half a per cent smaller than that of the circles.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_deformed, read_msh, von_mises
from fenics_tfeti.models import isotropic

here = Path(__file__).parent
results = Path("results")
dim = 3 if "3" in sys.argv[1:] else 2
name = "pile_of_cylinders" if dim == 2 else "pile_of_cylinders_3d"

# ## Mesh
#
# The surface named "left top" is the part of the left disc near the top one. Its nodes are mirror
# images of those of "top left". In three dimensions the cylinders are 0.25 m long.

pile = read_msh(here.parent / "meshes" / f"{name}.msh", MPI.COMM_WORLD, gdim=dim)
mesh, facet_tags, tags = pile.mesh, pile.facet_tags, pile.names
radius, length = 0.25, 0.25 if dim == 3 else 1.0

# ## Linear elasticity, in two dimensions with plane strain

E, nu = 0.5e9, 0.3
sigma = isotropic(E, nu)
up = np.eye(dim)[1]
weight = fem.Constant(mesh, -9810.0 * up)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = ufl.inner(weight, v) * ufl.dx

# ## Contact
#
# No displacement is prescribed: floor and walls are rigid planes.


def out_of_the_top(x):
    """Return the normal of the upper disc at points x."""
    return np.array([x[0], x[1] - 2.6 * radius, 0 * x[2]])[:dim] / radius


contacts, expected = [], {}
for side, sign in (("left", -1.0), ("right", 1.0)):
    inwards = -sign * np.eye(dim)[0]
    wall = Plane(point=-2.2 * radius * inwards, normal=inwards)
    floor = Plane(point=np.zeros(dim), normal=up)
    contacts += [
        ContactPair(
            facet_tags,
            slave=tags[f"top {side}"],
            master=tags[f"{side} top"],
            name=f"top on {side}",
            normal=out_of_the_top,
        ),
        RigidObstacle(facet_tags, tags[f"{side} floor"], floor, name=f"{side} on floor"),
        RigidObstacle(facet_tags, tags[f"{side} wall"], wall, name=f"{side} on wall"),
    ]
    expected[f"top on {side}"] = 5 / 8 * (-0.6 * inwards - 0.8 * up)
    expected[f"{side} on floor"] = -3 / 2 * up
    expected[f"{side} on wall"] = -3 / 8 * inwards

problem = ContactProblem(a, L, contacts=contacts, cell_tags=pile.cell_tags, options={"rtol": 1e-8})
uh = problem.solve()

# ## Results
#
# The weight of the mesh is slightly smaller than W, that of the circles.

report = problem.report
W = 9810 * np.pi * radius**2 * length
errors = {}
for contact in problem.results:
    contact = contact.gather()
    force, statics = contact.nodal_normal_force @ contact.normal / W, expected[contact.name]
    errors[contact.name] = np.linalg.norm(force - statics) / np.linalg.norm(statics)
    if mesh.comm.rank == 0:
        print(f"{contact.name:15s} {force.round(5)} W, relative error {errors[contact.name]:.1e}")
if mesh.comm.rank == 0:
    print("free motions:", *report.free_motions, sep="\n  ")

# The colours end at 20 kPa, to show how the forces are transmitted.

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu if dim == 2 else None)
draw_deformed(
    results / f"{name}.png",
    uh,
    stress,
    label="von Mises stress",
    limits=(0, 20),
    unit="kPa",
    title="Three loose cylinders in a trough",
    scale=100,
    camera=(0.15, -0.8, 1.0),
)
