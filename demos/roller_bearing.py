"""A roller bearing: loads of the rollers and pressures, with exact non-penetration.

# A roller bearing

Two rings of steel with two rows of inclined, crowned rollers between them. The outer ring is fixed
on its outside. A radial and an axial load act on the bore of the inner ring. Contact alone holds
all other bodies. This is the kind of problem of sec. 11.11.2, the bearing of a wind generator with
73 bodies of which one is fixed.

The load of each roller is compared with the classical model of Stribeck, Sjövall and Harris: rigid
rings, and rollers whose load is Q = K d^(10/9) for the approach d of the raceways, with Palmgren's
K = 80.6 kN/mm^(10/9) for a length of 1 mm, which grows with the length to the power of 8/9. Its
solution is that of five equations for the displacement and tilt of the inner ring.

This demo illustrates how to

- pair one surface with many bodies: the contact of a raceway has all rollers of a row as slaves;
- give the normals of the rollers: they point away from the axes, so that each roller is free to
  spin and to slide along its axis, and the report names these motions;
- use deflation and `preconditioner="dirichlet"` where subdomains of thin elements need them;
- cut all sectors equally by labels (`subdomains`): subdomains that are rotated or mirrored images
  of each other are found and share one stiffness matrix and one factor;
- compute the load of each body from the forces of the nodes, and draw it.

There is no cage in the small bearing. Without it and without friction, a roller between rings that
are not concentric is pushed slowly towards the wider gap. Each pass of the exact non-penetration
follows it by some micrometres along the raceway, while penetration and forces have converged.
The tolerance of `Deformed` is therefore 5e-3.

Run it by `python demos/roller_bearing.py`, or on several processes by
`mpirun -n 2 python demos/roller_bearing.py`. With the argument `full` it takes the full size of
sec. 11.11.2, 73 bodies with a cage and 2.8 million unknowns, some minutes and 5 GB. It writes the
mesh, made by `meshes/roller_bearing.py`, and pictures into `results/`. All units are SI.
"""

import sys
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.optimize import fsolve

import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_profile, piecewise_constant, read_msh
from fenics_tfeti.models import isotropic

here = Path(__file__).parent
sys.path.insert(0, str(here.parent / "meshes"))
from roller_bearing import (  # noqa: E402
    Bearing,
    roller_bearing,
    small_bearing,
    subdomain_labels,
)

from fenics_tfeti import Deformed

results = Path("results")
results.mkdir(exist_ok=True)
comm = MPI.COMM_WORLD

# ## Mesh

full = "full" in sys.argv[1:]
small = replace(small_bearing(), layers=14, shortest=0.8)
bearing, slices = (Bearing(), 4) if full else (small, 2)
radial, axial = 0.8e6, 0.16e6
name = "roller_bearing"
if comm.rank == 0:
    roller_bearing(results / f"{name}.msh", bearing)
comm.barrier()
bodies = read_msh(results / f"{name}.msh", comm, gdim=3)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names

# ## Linear elasticity

sigma = isotropic(2.1e11, 0.3)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
bore = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)(tags["bore"])
one = fem.Constant(mesh, 1.0)
area = comm.allreduce(fem.assemble_scalar(fem.form(one * bore)))
load = np.array([0.0, -radial, -axial])
traction = fem.Constant(mesh, load / area)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = ufl.inner(traction, v) * bore
outside = fem.locate_dofs_topological(V, 2, facet_tags.find(tags["outside"]))
bcs = [fem.dirichletbc(np.zeros(3), outside, V)]

# ## Contact
#
# Of each roller, the normals point away from its axis.

contacts = [
    ContactPair(
        facet_tags,
        slave=tags[f"rollers {row} {side}"],
        master=tags[f"{side} raceway {row}"],
        name=f"{side} raceway {row}",
        normal=bearing.away_from_axis(row),
    )
    for row in range(1, bearing.rows + 1)
    for side in ("outer", "inner")
]

for row in range(1, bearing.rows + 1) if bearing.cage else ():
    pockets, rollers = tags[f"pockets {row}"], tags[f"rollers {row} side"]
    contacts.append(ContactPair(facet_tags, pockets, rollers, name=f"pockets {row}"))

# ## Subdomains
#
# Labels of the cells by sectors; each roller, and each sector of a ring, is cut into slices.

owned = mesh.topology.index_map(3).size_local
middles = compute_midpoints(mesh, 3, np.arange(owned, dtype=np.int32))
cells = {body: bodies.cell_tags.find(tags[body]) for body in bearing.names}
labels = subdomain_labels(bearing, cells, middles, slices)

problem = ContactProblem(
    a,
    L,
    bcs=bcs,
    contacts=contacts,
    cell_tags=bodies.cell_tags,
    subdomains=labels,
    # of the full size the second pass ends at 1.6e-2
    gaps=Deformed(tolerance=3e-2 if full else 5e-3),
    options={"rtol": 1e-4, "preconditioner": "dirichlet", "deflation": "on"},
)
uh = problem.solve()
report = problem.report

# ## Loads of the rollers

raceways = {contact.name: contact.gather() for contact in problem.results}
loads = {}
for contact_name, contact in raceways.items():
    force = contact.nodal_normal_force[:, None] * contact.normal
    k = bearing.roller_of(contact.coordinates.T)
    sums = [np.bincount(k, force[:, i], bearing.rollers) for i in range(3)]
    loads[contact_name] = np.linalg.norm(sums, axis=0)

# Rigid rings: the approach of the raceways along the lines of contact follows from the displacement
# and the tilt of the inner ring.

stiffness = 80.6e3 * (1e3 * bearing.length) ** (8 / 9) * 1e3 ** (10 / 9)
rows = range(1, bearing.rows + 1)
places, _, outwards = np.concatenate([bearing.lines(row) for row in rows], axis=1)
levers = np.cross(places, outwards)


def rigid_loads(motion):
    """Return the loads of the rollers [N] of a displacement [mm] and tilt [mrad]."""
    approach = 1e-3 * (outwards @ motion[:3] + levers[:, :2] @ motion[3:]) - bearing.clearance
    return stiffness * np.maximum(approach, 0.0) ** (10 / 9)


def out_of_balance(motion):
    """Return the sums of forces and moments on the inner ring, relative to the load."""
    Q = rigid_loads(motion)
    forces, moments = load - Q @ outwards, -Q @ levers[:, :2] / bearing.pitch_radius
    return np.append(forces, moments) / radial


start = np.array([0.0, -0.15, -0.1, 0.0, 0.0])
rigid = rigid_loads(fsolve(out_of_balance, start)).reshape(bearing.rows, -1)

# ## Results

sums = {n: c.nodal_normal_force @ c.normal for n, c in raceways.items() if "raceway" in n}
on_inner = sum(force for n, force in sums.items() if "inner" in n)
on_outer = -sum(force for n, force in sums.items() if "outer" in n)
balance = max(np.abs(force + sign * load).max() for force, sign in ((on_inner, 1), (on_outer, 1)))
if comm.rank == 0:
    products = sum(one_pass.products for one_pass in report.passes)
    print(
        f"{report.unknowns['primal']} unknowns, {report.subdomains} subdomains of {report.classes} "
        f"shapes, {products} iterations in {len(report.passes)} passes"
    )
    print(f"{len(report.free_motions)} free motions; balance {balance / radial:.1e} of the load")
    for row in rows:
        table = np.stack([loads[f"outer raceway {row}"], rigid[row - 1]]).round(-2) / 1e3
        print(f"row {row}: loads of the rollers [kN], elastic and rigid rings", *table, sep="\n")

# The row that carries more, and the pressure along its loaded rollers on one side of the load.

row = 1 + int(np.argmax([loads[f"outer raceway {r}"].max() for r in rows]))
inner, curves = raceways[f"inner raceway {row}"], {}
roller_of_node = bearing.roller_of(inner.coordinates.T)
for k in range(bearing.rollers // 2):
    chosen = roller_of_node == k
    centre, axis, _ = bearing.lines(row)[:, k]
    along = ((inner.coordinates[chosen] - centre) @ axis).round(6)
    stations = np.unique(along)
    pressure = np.array([inner.pressure[chosen][along == station].max() for station in stations])
    if pressure.any():
        angle = np.degrees(bearing.azimuth(k) - bearing.azimuth(0))
        curves[f"{angle:.0f} degrees from the load"] = 1e3 * stations, 1e-6 * pressure, "o-"

draw_profile(
    results / f"{name}_pressure.png",
    curves,
    xlabel="position along the roller [mm]",
    ylabel="largest normal pressure [MPa]",
    title=f"Pressures along the rollers of row {row}",
)
if comm.rank == 0:
    from matplotlib.figure import Figure

    azimuth = np.array([bearing.azimuth(k) for k in range(bearing.rollers)])
    figure = Figure(figsize=(10, 5.4), dpi=160, layout="constrained")
    for column, r in enumerate(rows, start=1):
        axes = figure.add_subplot(1, bearing.rows, column, projection="polar")
        around = np.append(azimuth, azimuth[0] + 2 * np.pi)
        curves = (
            ("elastic rings", loads[f"outer raceway {r}"], "o-"),
            ("rigid", rigid[r - 1], "--"),
        )
        for label, values, style in curves:
            axes.plot(around, np.append(values, values[0]) / 1e3, style, label=label)
        axes.set_title(f"row {r}: loads of the rollers [kN]")
        axes.legend(loc="upper left", bbox_to_anchor=(-0.1, 1.02), frameon=False)
    figure.savefig(results / f"{name}_loads.png")

# The loads as colours of the rollers, without the outer ring: the loaded zone.

load_of = {tags[body]: 0.0 for body in bearing.names}
for row in rows:
    for k, force in enumerate(loads[f"outer raceway {row}"]):
        load_of[tags[f"roller {(row - 1) * bearing.rollers + k + 1}"]] = force
problem.draw(
    results / f"{name}.png",
    piecewise_constant(mesh, bodies.cell_tags, load_of),
    label="load of the roller",
    unit="kN",
    title="A roller bearing without its outer ring",
    limits=(0.0, 1e-3 * max(load_of.values())),
    cells=np.concatenate([part for body, part in cells.items() if body != "outer ring"]),
    camera=(0.5, -1.0, 0.5),
)
report.to_json(results / f"{name}.json")
