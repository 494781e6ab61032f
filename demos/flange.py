r"""A flange with three bolts: tightened one after the other, then pulled apart.

# A bolted flange

Two pipes of steel are joined by flanges, with a soft gasket between them, and three bolts. All
bolts are screwed in by hand, then each is tightened by a wrench to the same force, one after the
other. Each one that is tightened presses the flanges together, which
changes the tension of those before. Then the pipes are pulled apart by a force F. Of it the bolts
feel a part only, while the flanges press on each other: the load factor.

The cut through a shank, where the bolt is tightened, is a surface of facets inside the bolt. A
`BoltPreload` with a force finds by how much the shank is shortened there; `locked` keeps the
shortening for the steps that follow.

This demo illustrates how to

- give the two sides of a cut inside a body nodes of their own, when the mesh is read;
- tighten bolts in an order, and lock them;
- read the tension of a bolt in each load step.

Run it by `python demos/flange.py`, or on several processes by `mpirun -n 2 python demos/flange.py`;
it draws pictures into `results/`. The mesh comes from `meshes/flange.py`. A largest pull in kN,
such as 15, may be given instead of 60. All units are SI.
"""

import sys
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import BoltPreload, ContactPair, ContactProblem
from fenics_tfeti.io import (
    Interface,
    displacement_space,
    draw_deformed,
    draw_profile,
    piecewise_constant,
    read_msh,
    von_mises,
)
from fenics_tfeti.models import isotropic

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD
(largest,) = map(float, sys.argv[1:] or [60])

# ## Mesh
#
# The cut of each bolt is opened: its sides are the surfaces "below 1" and "above 1".

numbers = (1, 2, 3)
cuts = [
    Interface((f"bolt {k}", f"bolt {k}"), (f"below {k}", f"above {k}"), facets=f"cut {k}")
    for k in numbers
]
parts = read_msh(here.parent / "meshes" / "flange.msh", comm, split=cuts)
mesh, facet_tags, tags = parts.mesh, parts.facet_tags, parts.names

# ## Linear elasticity

steel, fibre = 2.1e11, 1e9
bodies = ["upper", "lower", *(f"bolt {k}" for k in numbers)]
young = {tags[name]: steel for name in bodies} | {tags["gasket"]: fibre}
sigma = isotropic(piecewise_constant(mesh, parts.cell_tags, young), 0.3)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
end = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)(tags["pulled"])
area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * end)))
pull = fem.Constant(mesh, 0.0)
L = pull / area * v[2] * end
fixed = fem.locate_dofs_topological(V, 2, facet_tags.find(tags["fixed"]))
bcs = [fem.dirichletbc(np.zeros(3), fixed, V)]

# ## Contacts and bolts

pairs = {"above": ("gasket above", "upper face"), "below": ("gasket below", "lower face")}
pairs |= {"heads": ("heads", "upper seats"), "nuts": ("nuts", "lower seats")}
contacts = [
    ContactPair(facet_tags, slave=tags[slave], master=tags[master], name=name)
    for name, (slave, master) in pairs.items()
]
preload, snug = 30e3, 5e3
bolts = [
    BoltPreload(facet_tags, tags[f"below {k}"], tags[f"above {k}"], force=snug, name=f"bolt {k}")
    for k in numbers
]
problem = ContactProblem(a, L, bcs=bcs, contacts=[*contacts, *bolts], options={"rtol": 1e-5})


def tensions():
    """Return the tension of each bolt [N]."""
    return [problem.results[bolt.name].tension for bolt in bolts]


# ## Tightening
#
# First by hand, all at once, then by the wrench, one after the other. A bolt is locked at all times
# but when it is tightened.

first, history = len(contacts), []
problem.solve()
problem.advance()
problem.contacts[first:] = [bolt.locked(problem.results[bolt.name]) for bolt in bolts]
for k, bolt in enumerate(bolts, start=first):
    problem.contacts[k] = replace(bolt, force=preload)
    problem.solve()
    problem.advance()
    history.append(tensions())
    problem.contacts[k] = bolt.locked(problem.results[bolt.name])

# ## Pulling

loads = 1e3 * np.arange(0.0, largest + 1.0, 15.0)
pulled = []
for load in loads:
    pull.value = load
    uh = problem.solve()
    problem.advance()
    pulled.append(tensions())
pulled = np.array(pulled)
factor = (pulled[1] - pulled[0]).sum() / loads[1]
if comm.rank == 0:
    for k, row in enumerate(history, start=1):
        print(f"bolt {k} tightened: tensions", *(f"{tension / 1e3:.2f}" for tension in row), "kN")
    print(f"of a pull of {loads[1] / 1e3:.0f} kN the bolts feel {factor:.1%}")

# ## Pictures

draw_profile(
    results / "flange_tension.png",
    {f"bolt {k}": (loads / 1e3, pulled[:, k - 1] / 1e3, "o-") for k in numbers},
    xlabel="pull [kN]",
    ylabel="tension of the bolt [kN]",
    title="Bolts of a flange that is pulled apart",
)
stress = von_mises(mesh, sigma(uh), poisson_ratio=None)
draw_deformed(
    results / "flange.png",
    uh,
    stress,
    label="von Mises stress",
    limits=(0, 400),
    unit="MPa",
    title="A flange with three bolts",
    scale=15,
    camera=(1.0, -0.7, 0.5),
)
