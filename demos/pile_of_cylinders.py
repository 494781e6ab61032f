"""Three loose cylinders in a trough, under their own weight: contact forces by statics.

# A pile of cylinders

Two plastic cylinders, 0.5 m thick, lie on the floor between two rigid walls, and a third one lies
upon both. Nothing else holds them. They are stiff (0.5 GPa) and light, so each place of contact is
only 0.01 radii wide, and the bodies move by 0.0002 radii: the forces are those of rigid discs on
points of contact, but for some parts in ten thousand. With the slope 4/3 of the line of centres and
the weight W, the upper disc presses 5/8 W on each of the lower ones, these press 3/8 W on the walls
and 3/2 W on the floor.

This demo illustrates how to

- put bodies on each other that touch at a point before they deform: only the surface near this
  point is tagged, since gaps grow with the square of the distance from it;
- give the normals of a round surface;
- read from the report which motions nothing resists: without friction the upper disc is free to
  spin about its axis. The smallest displacement is returned, forces and stresses are unique;
- check a solution by statics.

Why can the lower discs not spin? The contact conditions are those of the undeformed surfaces. Where
the rigid floor touches several nodes, a rotation would press those to one side of the centre into
the floor, and lift those to the other side off. On the upper disc, which is the slave, all normals
meet in its axis, and no rotation about it changes any distance.

Run it by `python demos/pile_of_cylinders.py`, or in three dimensions by
`python demos/pile_of_cylinders.py 3`, where all three cylinders are also free to slide along their
axes; it writes a picture and fields into `results/`. The mesh in three dimensions is a coarse one:
what the polygons lack of the circle's weight makes errors of half a per cent.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.io import (
    contact_fields,
    displacement_space,
    draw_deformed,
    read_msh,
    von_mises,
    write_fields,
)

here = Path(__file__).parent
results = here.parent / "results"
dim = 3 if "3" in sys.argv[1:] else 2
name = "pile_of_cylinders" if dim == 2 else "pile_of_cylinders_3d"

# One line for each outer iteration of the solver, from rank 0.
logging.basicConfig(stream=sys.stdout, level=logging.WARNING, format="%(message)s", force=True)
logging.getLogger("fenics_tfeti").setLevel(logging.INFO)

# ## Mesh
#
# The surface with the name "left top" is that of the left disc where it touches the top one. Its
# nodes are mirror images of those of "top left". In 3D, the cylinders are 0.25 m long.

pile = read_msh(here.parent / "meshes" / f"{name}.msh", MPI.COMM_WORLD, gdim=dim)
mesh, facet_tags, tags = pile.mesh, pile.facet_tags, pile.names
radius, length = 0.25, 0.25 if dim == 3 else 1.0

# ## Linear elasticity, in 2D with plane strain

E, nu = 0.5e9, 0.3
mu = fem.Constant(mesh, E / (2 * (1 + nu)))
lmbda = fem.Constant(mesh, E * nu / ((1 + nu) * (1 - 2 * nu)))
up = np.eye(dim)[1]
weight = fem.Constant(mesh, -9810.0 * up)


def epsilon(u):
    """Return the small strain."""
    return ufl.sym(ufl.grad(u))


def sigma(u):
    """Return the stress [Pa]."""
    return lmbda * ufl.tr(epsilon(u)) * ufl.Identity(dim) + 2 * mu * epsilon(u)


V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(sigma(u), epsilon(v)) * ufl.dx
L = ufl.inner(weight, v) * ufl.dx

# ## Contact
#
# There are no supports at all: floor and walls are rigid planes.


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

# ## What came out
#
# The weight of the discs is that of the mesh, a little less than the circles' own.

report = problem.report
W = 9810 * np.pi * radius**2 * length
dx = ufl.Measure("dx", domain=mesh, subdomain_data=pile.cell_tags)
one = fem.Constant(mesh, 1.0)
mass = {body: fem.assemble_scalar(fem.form(one * dx(tags[body]))) for body in ("left", "top")}
meshed = {body: 9810 * mesh.comm.allreduce(volume) for body, volume in mass.items()}
if mesh.comm.rank == 0:
    print("unknowns     ", report.unknowns, "in", report.subdomains, "subdomains")
    print("products     ", report.products, "in", report.outer_iterations, "outer iterations")
    print("free motions ", *report.free_motions, sep="\n  ")
    print("certificate  ", {k: f"{v:.1e}" for k, v in report.to_dict()["certificate"].items()})
    print("weight       ", {body: f"{w / W:.6f} W" for body, w in meshed.items()})
    results.mkdir(exist_ok=True)
for contact in problem.contact:
    contact = contact.gather()
    force = contact.normal_force @ contact.normal / W
    error = np.linalg.norm(force - expected[contact.name]) / np.linalg.norm(expected[contact.name])
    if mesh.comm.rank == 0:
        pressing = np.count_nonzero(contact.active)
        print(
            f"{contact.name:15s} {force.round(5)} W on {pressing} nodes, relative error {error:.1e}"
        )
mesh.comm.barrier()
report.to_json(results / f"{name}.json")

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu if dim == 2 else None)
write_fields(results / f"{name}.pvd", [uh, stress, *contact_fields(V, problem.contact)])
# The stress is a thousand times higher at the contacts than elsewhere: drawn up to 20 kPa, it shows
# the way of the forces.

stress.x.array[:] = np.minimum(stress.x.array, 20e3)
draw_deformed(
    results / f"{name}.png",
    uh,
    stress,
    label="von Mises stress (capped)",
    unit="kPa",
    title="Three loose cylinders in a trough",
    scale=100,
    camera=(0.15, -0.8, 1.0),
)
