r"""One sector of a roller bearing under an axial load, with cyclic borders.

# A sector of a bearing

An axial load F on the inner ring of a bearing with one row of inclined rollers loads all of them
alike. Therefore one sector with one roller is enough. Its borders are cuts through both rings. With
the rotation Q from one border to the other,

$$u(Q x) = Q u(x),$$

which a `PeriodicPair` holds at the nodes of both rings. The meshes of the borders match.

The load of a roller follows from equilibrium, as only its normal forces have an axial component:
Q = F / (n sin alpha) for n rollers inclined by alpha. The pressure in the middle of a roller is
compared with that of Hertz's contact of two cylinders under the load Q / l everywhere. Rollers are
crowned, so that it is larger.

This demo illustrates how to

- compute a cyclic body by one sector;
- solve all of it with the same script: `python demos/bearing_sector.py whole` takes the whole ring,
  eight times as large, and finds the same loads and pressures up to `rtol`.

Run it by `python demos/bearing_sector.py`, or on several processes by
`mpirun -n 2 python demos/bearing_sector.py`. It writes the mesh, made by
`meshes/roller_bearing.py`, and a picture into `results/`. All units are SI.
"""

import sys
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, PeriodicPair
from fenics_tfeti.io import displacement_space, draw_deformed, read_msh, von_mises
from fenics_tfeti.models import isotropic

here = Path(__file__).parent
sys.path.insert(0, str(here.parent / "meshes"))
from roller_bearing import roller_bearing, small_bearing  # noqa: E402

results = Path("results")
results.mkdir(exist_ok=True)
comm = MPI.COMM_WORLD

# ## Mesh

whole = "whole" in sys.argv[1:]
bearing = replace(small_bearing(), rows=1, strip=1e-3, elements=8, growth=1.4, layers=8)
n = bearing.rollers
name = "bearing" if whole else "bearing_sector"
file = results / f"{name}.msh"
if comm.rank == 0:
    roller_bearing(file, bearing, sector=not whole)
comm.barrier()
bodies = read_msh(file, comm, gdim=3)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names

# ## Linear elasticity
#
# The load of the sector is one n-th of all.

E, nu, axial = 2.1e11, 0.3, 4e5
sigma = isotropic(E, nu)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
bore = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)(tags["bore"])
area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * bore)))
force = axial if whole else axial / n
L = ufl.inner(fem.Constant(mesh, np.array([0.0, 0.0, -force / area])), v) * bore
outside = fem.locate_dofs_topological(V, 2, facet_tags.find(tags["outside"]))
bcs = [fem.dirichletbc(np.zeros(3), outside, V)]

# ## Contact and borders

contacts = [
    ContactPair(
        facet_tags,
        slave=tags[f"rollers 1 {side}"],
        master=tags[f"{side} raceway 1"],
        name=side,
        normal=bearing.away_from_axis(1),
    )
    for side in ("outer", "inner")
]
if not whole:
    c, s = np.cos(2 * np.pi / n), np.sin(2 * np.pi / n)
    turn = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    borders = tags["second border"], tags["first border"]
    contacts.append(PeriodicPair(facet_tags, *borders, rotation=turn, name="borders"))

options = {"rtol": 1e-6, "preconditioner": "dirichlet", "deflation": "on"}
problem = ContactProblem(a, L, bcs=bcs, contacts=contacts, options=options)
uh = problem.solve()

# ## Load and pressure of a roller

inner = problem.results["inner"].gather()
Q = inner.nodal_normal_force.sum() / (n if whole else 1)
statics = axial / (n * np.sin(bearing.alpha))
radius = (bearing.pitch_radius - bearing.radius * np.cos(bearing.alpha)) / np.cos(bearing.alpha)
curvature = 1 / bearing.radius + 1 / radius
p_hertz = np.sqrt(Q / bearing.length * E / (1 - nu**2) / 2 * curvature / np.pi)
centre, axis, _ = bearing.lines(1)[:, 0]
along = (inner.coordinates - centre) @ axis
middle = (np.abs(along) < 0.1 * bearing.length) & (bearing.roller_of(inner.coordinates.T) == 0)
p_middle = inner.pressure[middle].max()
if comm.rank == 0:
    report = problem.report
    print(f"{report.unknowns['primal']} unknowns, {report.products['total']} iterations")
    print(f"load of a roller {Q / 1e3:.3f} kN; statics {statics / 1e3:.3f} kN")
    print(f"pressure in its middle {p_middle / 1e6:.0f} MPa; without crown {p_hertz / 1e6:.0f} MPa")

# ## Picture

stress = von_mises(mesh, sigma(uh), poisson_ratio=None)
draw_deformed(
    results / "bearing_sector.png",
    uh,
    stress,
    label="von Mises stress",
    limits=(0, 100),
    unit="MPa",
    title="One sector of a roller bearing",
    scale=20,
    camera=(1.0, -0.7, 0.6),
)
