"""A rigid shaft turns in the bore of a hub until a key stops it.

# Shaft and key

A key of steel in the grooves of a shaft and a hub transmits a moment of 500 N m per metre. The
shaft is a rigid body of the mesh: none of its cells is assembled, three numbers are its motion.
Without friction the bore only bears the force with which the key pushes the shaft aside; the moment
goes through the flanks of the key.

This demo illustrates how to

- declare a body of the mesh rigid, and load it by a moment;
- find the contacts of all bodies, here five pairs, without tags of surfaces;
- read motion and forces of a rigid body.

Run it by `python demos/shaft_and_key.py`, or on several processes by
`mpirun -n 2 python demos/shaft_and_key.py`; it draws a picture into `results/`. The mesh comes
from `meshes/shaft_and_key.py`. All units are SI, forces are per metre of length.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidBody
from fenics_tfeti.io import displacement_space, draw_deformed, read_msh, von_mises
from fenics_tfeti.models import isotropic

here = Path(__file__).parent

# ## Mesh, elasticity and supports
#
# The hub is held outside.

bodies = read_msh(here.parent / "meshes" / "shaft_and_key.msh", MPI.COMM_WORLD, gdim=2)
mesh, tags = bodies.mesh, bodies.names
sigma = isotropic(2.1e11, 0.3)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
held = fem.locate_dofs_topological(V, 1, bodies.facet_tags.find(tags["outside"]))
bcs = [fem.dirichletbc(np.zeros(2), held, V)]

# ## The shaft
#
# It may move in the bore, and turn.

moment = 500.0
shaft = RigidBody(reference=(0.0, 0.0), moment=moment, name="shaft")
problem = ContactProblem(
    a,
    0,
    bcs=bcs,
    contacts="auto",
    cell_tags=bodies.cell_tags,
    rigid_bodies={tags["shaft"]: shaft},
)
uh = problem.solve()

# ## Motion and forces
#
# The names of the pairs have those of both bodies. Moments are about the axis.


def on_shaft(partner):
    """Return the force and the moment that another body exerts on the shaft."""
    names, total = ("(shaft)", f"({partner})"), np.zeros(3)
    for contact in problem.report.contacts:
        slave, master = contact.name.split(" on ")
        if names[0] in slave and names[1] in master:
            total += [*contact.force, *contact.moment]
        if names[1] in slave and names[0] in master:
            total += [*contact.force_on_master, *contact.moment_on_master]
    return total


rotation = problem.rigid_bodies["shaft"].rotation[0]
by_key, by_bore = on_shaft("key"), on_shaft("hub")
if mesh.comm.rank == 0:
    print(f"{len(problem.contacts)} pairs; the shaft turns by {1e3 * rotation:.3f} mrad")
    print(f"the key takes {-by_key[2]:.1f} N m/m, the bore {abs(by_bore[2]):.1f} N m/m")
    print(f"the key pushes the shaft aside by {1e-3 * np.hypot(*by_key[:2]):.1f} kN/m")

# ## Picture

draw_deformed(
    Path("results") / "shaft_and_key.png",
    uh,
    von_mises(mesh, sigma(uh), poisson_ratio=0.3),
    label="von Mises stress",
    unit="MPa",
    title="A rigid shaft, its key, and the hub",
)
