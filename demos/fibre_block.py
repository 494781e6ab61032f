"""Rubber with steel cords under a punch: stiff fibres that the subdomains cut.

# Fibre-reinforced block

A block of rubber, 80 mm x 40 mm, is reinforced by six layers of steel cords and stands on a fixed
base. A steel punch of 30 mm presses it, in plane strain. Steel is ten thousand times as stiff as
rubber. The subdomains are cut without regard to the cords: pieces of steel end at their boundaries,
embedded in rubber. Such a piece moves as a rigid body at the cost of rubber, and with it the jump
at its end, which gluing has to close, at the weight of steel. These motions are isolated large
eigenvalues of the dual operators. They are found, and deflated, where the stiffness jumps on an
interface. The option `deflation="off"` leaves them to the conjugate gradients.

This demo illustrates how to

- give the modulus by an expression of the coordinates;
- give the subdomains by labels of the cells;
- read from the report what deflation costs and saves.

Run it by `python demos/fibre_block.py`, or on several processes by
`mpirun -n 2 python demos/fibre_block.py`; it draws pictures into `results/`. Tolerances other than
0.1, 1e-3 and 1e-6 may be given. All units are SI.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
    von_mises,
)
from fenics_tfeti.models import isotropic, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Mesh
#
# Squares of 1 mm. Block and punch have nodes of their own, which match at the contact.

mm = 1e-3
block = Box((0, 0), (80 * mm, 40 * mm), divisions=(80, 40), name="block")
punch = Box((25 * mm, 40 * mm), (55 * mm, 60 * mm), divisions=(30, 20), name="punch")
bodies = boxes(comm, [block, punch], "quadrilateral")
mesh = bodies.mesh
BASE, TOP, FACE, LOADED = 1, 2, 3, 4


def at(axis, value):
    """Return a marker of the facets on a line across an axis."""
    return lambda x: np.isclose(x[axis], value)


facet_tags = tag_facets(
    mesh,
    [
        (BASE, at(1, 0.0)),
        (TOP, at(1, 40 * mm), bodies.names["block"]),
        (FACE, at(1, 40 * mm), bodies.names["punch"]),
        (LOADED, at(1, 60 * mm)),
    ],
    bodies.cell_tags,
)

# ## Materials
#
# Cords of 2 mm, every 6 mm, in the block; their modulus changes from solution to solution.

steel, rubber, nu = 2.1e11, 2.1e7, 0.3
x = ufl.SpatialCoordinate(mesh)
bottoms = [(6 * k + 3) * mm for k in range(6)]
in_cord = sum(
    ufl.conditional(ufl.And(ufl.gt(x[1], y), ufl.lt(x[1], y + 2 * mm)), 1.0, 0.0) for y in bottoms
)
of_cords = fem.Constant(mesh, steel)
in_punch = ufl.conditional(ufl.gt(x[1], 40 * mm), 1.0, 0.0)
E = rubber + in_cord * (of_cords - rubber) + in_punch * (steel - rubber)
sigma = isotropic(E, nu)

# ## Forms and supports
#
# The top of the punch moves up and down only. It is pressed by 1 MPa.

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
pressure = 1e6
a_form = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L_form = -fem.Constant(mesh, pressure) * v[1] * ds(LOADED)
base = fem.locate_dofs_topological(V, 1, facet_tags.find(BASE))
bcs = [fem.dirichletbc(np.zeros(2), base, V), symmetry_plane(V, facet_tags, LOADED, axis=0)]

# ## Subdomains
#
# Slanted stripes of about 10 mm, in both directions.


def subdomain(x):
    """Return the number of the subdomain at points (3, n)."""
    up, along = (x[1] - 0.3 * x[0]) / (10 * mm), (x[0] + 0.3 * x[1]) / (10 * mm)
    return 20 * np.floor(up) + np.floor(along)


owned = mesh.topology.index_map(2).size_local
labels = subdomain(compute_midpoints(mesh, 2, np.arange(owned, dtype=np.int32)).T)


def solve(**options):
    """Return the solved problem and the displacement."""
    pair = ContactPair(facet_tags, slave=FACE, master=TOP)
    problem = ContactProblem(
        a_form, L_form, bcs=bcs, contacts=[pair], subdomains=labels.astype(int), options=options
    )
    return problem, problem.solve()


# ## With and without deflation, and without cords
#
# The iterations that an accuracy takes. Without cords, all is rubber except for the punch.

tolerances = np.array(sys.argv[1:] or [1e-1, 1e-3, 1e-6], dtype=float)
cases = {
    "steel cords, deflation": (steel, "auto", "o-"),
    "rubber alone": (rubber, "auto", "s-"),
    "steel cords, no deflation": (steel, "off", "^-"),
}
products, energies, curves, solved = {}, {}, {}, {}
for name, (modulus, deflation, style) in cases.items():
    of_cords.value = modulus
    for rtol in tolerances:
        solved[name, rtol] = solve(rtol=rtol, deflation=deflation)
    reports = [solved[name, rtol][0].report for rtol in tolerances]
    products[name] = np.array([report.products["total"] for report in reports])
    energies[name] = reports[-1].energy
    curves[name] = (products[name], np.log10(tolerances), style)

# ## What deflation costs

of_cords.value = steel
problem, uh = solved["steel cords, deflation", tolerances[-1]]
report = problem.report
if comm.rank == 0:
    vectors, memory = report.deflation["vectors"], report.deflation["bytes"]
    for name, counts in products.items():
        print(f"{name}: {counts[-1]} iterations at rtol {tolerances[-1]:.0e}")
    print(f"deflation: {vectors} vectors, {memory / 1e6:.1f} MB")

# ## Pictures
#
# The first one shows the subdomains, and their parts of the cords in paler colours.

stress = von_mises(mesh, sigma(uh), poisson_ratio=nu)
pieces = stress.copy()
pieces.name = "subdomain"
midpoints = pieces.function_space.tabulate_dof_coordinates().T
cords = (midpoints[1] % (6 * mm) > 3 * mm) & (midpoints[1] % (6 * mm) < 5 * mm)
colour = 2 + (3 * subdomain(midpoints) + 7 * np.floor(subdomain(midpoints) / 20)) % 8
pieces.x.array[:] = np.where(cords & (midpoints[1] < 39 * mm), 0.15 * colour, colour)
draw_deformed(
    results / "fibre_block.png",
    uh,
    pieces,
    label="subdomains; cords below 1.5",
    title="Steel cords in rubber, cut by the subdomains",
)
draw_profile(
    results / "fibre_block_products.png",
    curves,
    xlabel="iterations",
    ylabel="log10 of the relative error",
    title="With and without deflation",
)
