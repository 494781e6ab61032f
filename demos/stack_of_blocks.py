"""Twenty-seven loose blocks in a box: every surface a contact.

# A stack of blocks

3 x 3 x 3 concrete cubes of 1 m stand in a rigid box, open at the top. Each cube has nodes of its
own, and each of the 54 faces between two cubes is a contact pair. The floor and the walls of the
box are rigid planes.

No displacement is prescribed: contact alone supports all 27 bodies, against their weight and a
pressure on the top that grows towards one corner of the box. Some edges of the cubes lift off.

This demo illustrates how to

- build many contact pairs from the names of surfaces in the mesh file;
- take the stress of an isotropic material from `fenics_tfeti.models`;
- support bodies by rigid obstacles alone;
- check a solution by statics: without friction the forces of the walls and the neighbouring columns
  are horizontal, so each column of three cubes carries its own load.

Run it by `python demos/stack_of_blocks.py`, or on several processes by
`mpirun -n 2 python demos/stack_of_blocks.py`; it draws a picture into `results/`.
"""

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

# ## Mesh
#
# The surface named "2 1 3 +x" is the face of the cube (2, 1, 3) at its larger x.

stack = read_msh(here.parent / "meshes" / "stack_of_blocks.msh", MPI.COMM_WORLD)
mesh, facet_tags, tags = stack.mesh, stack.facet_tags, stack.names
cubes = [(i, j, k) for k in (1, 2, 3) for j in (1, 2, 3) for i in (1, 2, 3)]

# ## Linear elasticity
#
# Concrete: Young's modulus 30 GPa, Poisson's ratio 0.2, weight 24 kN/m^3.

sigma = isotropic(30e9, 0.2)
weight = fem.Constant(mesh, np.array([0.0, 0.0, -24e3]))
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = ufl.inner(weight, v) * ufl.dx

# The pressure on the top is 20 MPa (x/3)^4 (y/3)^4; `load` is its integral over a column.

x = ufl.SpatialCoordinate(mesh)
top = tuple(tags[f"{i} {j} 3 +z"] for i, j, k in cubes if k == 3)
L -= 20e6 * (x[0] / 3 * x[1] / 3) ** 4 * v[2] * ds(top)


def load(i, j):
    """Return the force on the top of a column [N]."""
    along_x, along_y = (3 / 5 * ((n / 3) ** 5 - ((n - 1) / 3) ** 5) for n in (i, j))
    return 20e6 * along_x * along_y


# ## Contact
#
# Each face between two cubes is a pair; each face at floor or wall has a rigid plane as obstacle.


def contacts_of_stack(facet_tags, tags):
    """Return the 54 pairs and the 45 obstacles."""
    contacts = []
    for cube in cubes:
        name = "{} {} {}".format(*cube)
        for axis, letter in enumerate("xyz"):
            e = np.eye(3)[axis]
            if cube[axis] < 3:
                above = "{:.0f} {:.0f} {:.0f}".format(*(cube + e))
                pair = tags[f"{above} -{letter}"], tags[f"{name} +{letter}"]
                contacts.append(ContactPair(facet_tags, *pair, name=f"{above} on {name}"))
            elif letter != "z":
                wall = Plane(point=3 * e, normal=-e)
                face = tags[f"{name} +{letter}"]
                contacts.append(RigidObstacle(facet_tags, face, wall, name=f"{name} +{letter}"))
            if cube[axis] == 1:
                wall = Plane(point=0 * e, normal=e)
                face = tags[f"{name} -{letter}"]
                contacts.append(RigidObstacle(facet_tags, face, wall, name=f"{name} -{letter}"))
    return contacts


contacts = contacts_of_stack(facet_tags, tags)
problem = ContactProblem(a, L, contacts=contacts, options={"rtol": 1e-8})
uh = problem.solve()

# ## Results
#
# Each horizontal face below the top carries the load of its column and the weight above it.

report = problem.report
carried = dict(
    zip(
        [contact.name for contact in contacts],
        [c.normal_force for c in report.contacts],
        strict=True,
    )
)
worst = 0.0
for i, j, k in cubes:
    below = f"{i} {j} {k} on {i} {j} {k - 1}" if k > 1 else f"{i} {j} {k} -z"
    expected = load(i, j) + 24e3 * (4 - k)
    worst = max(worst, abs(carried[below] / expected - 1))
if mesh.comm.rank == 0:
    print(f"{report.unknowns['active']} of {report.unknowns['inequalities']} conditions are active")
    print(f"the force through each face is that of statics, within {worst:.1e}")
    print("free motions:", ", ".join(report.free_motions) or "none")

draw_deformed(
    results / "stack_of_blocks.png",
    uh,
    von_mises(mesh, sigma(uh)),
    label="von Mises stress",
    unit="MPa",
    title="27 loose blocks in a rigid box",
    camera=(1.0, 1.2, 0.6),
)
