"""A laminate that splits: its load beside beam theory and a published curve.

# Delaminating beam

Two arms of laminate, 100 x 25 x 2.1 mm each, are bonded beyond a crack of 48 mm, and clamped at
the other end. Where the crack is open, they are moved apart: a double cantilever beam, the test by
which the energy of delamination is measured. The bond has a strength of 87 MPa, and its failure
takes 1.12 N/mm.

With beam theory, the arms are cantilevers, longer than the crack by chi h each (Williams), h being
their height. The load rises with the opening until the energy that the growth of the crack releases
is that of the bond, and falls from there as the crack grows:

$$P = \\frac{\\sqrt{G b E I}}{a + \\chi h}, \\qquad
\\delta = \\frac{2 P (a + \\chi h)^3}{3 E I}.$$

Data and the published curve, whose peak is 167 N at 5.7 mm (read off a figure, to 3 N), are those
of Tijs, Turon and Bisagni, Composites A 162 (2022) 107101.

This demo illustrates how to

- bond surfaces by `Cohesive`, and accept load steps with their damage;
- draw all equilibria that a solve has passed, from `report.damage.path`;
- compare the energy that the bond has taken with the length of the new crack.

Run it by `python demos/delaminating_beam.py`, or on several processes by
`mpirun -n 2 python demos/delaminating_beam.py`; it draws pictures into `results/`. The number of
load steps may be given. Units are mm, N and MPa; forces of the model are per mm of width.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import Cohesive, ContactPair, ContactProblem
from fenics_tfeti.io import (
    Box,
    boxes,
    contact_fields,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
)

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# Moduli of the laminate along the beam (1) and across (2, 3), in plane strain, of which nu23 is not
# published; length, crack, height and width.

E1, E2, G12, nu12, nu23 = 133150.0, 10950.0, 5190.0, 0.316, 0.46
length, crack, h, width = 100.0, 48.0, 2.1, 25.0
strength, energy = 87.0, 1.12

S = np.diag([1 / E1, 1 / E2, 1 / E2])
S[0, 1:] = S[1:, 0] = -nu12 / E1
S[1, 2] = S[2, 1] = -nu23 / E2
C = np.linalg.inv(S)[:2, :2]
D = ufl.as_matrix([[C[0, 0], C[0, 1], 0], [C[1, 0], C[1, 1], 0], [0, 0, G12]])

# ## Mesh
#
# The bond softens over about 1.5 mm before the crack, for which cells of 0.25 mm are fine enough.

arms = [
    Box((0, 0), (length, h), (400, 6), "lower arm"),
    Box((0, h), (length, 2 * h), (400, 6), "upper arm"),
]
bodies = boxes(comm, arms, "quadrilateral")


def bonded(x):
    return np.isclose(x[1], h) & (x[0] > crack - 1e-6)


def end(x):
    return np.isclose(x[0], length)


tags = tag_facets(
    bodies.mesh, [(1, bonded, 1), (2, bonded, 2), (3, end, 1), (3, end, 2)], bodies.cell_tags
)

# ## Problem
#
# The middle of each arm's end is moved by half of the opening.

V = displacement_space(bodies.mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)


def strain(w):
    e = ufl.sym(ufl.grad(w))
    return ufl.as_vector([e[0, 0], e[1, 1], 2 * e[0, 1]])


a = ufl.inner(D * strain(u), strain(v)) * ufl.dx
bcs = [fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, tags.find(3)), V)]
across = V.sub(1).collapse()[0]
tips = [fem.Function(across), fem.Function(across)]
for height, tip in zip((0.5 * h, 1.5 * h), tips, strict=True):
    dofs = fem.locate_dofs_geometrical(
        (V.sub(1), across),
        lambda x, height=height: np.isclose(x[0], 0) & np.isclose(x[1], height),
    )
    bcs.append(fem.dirichletbc(tip, dofs, V.sub(1)))

bond = ContactPair(tags, 1, 2, law=Cohesive(strength, energy), name="bond")
problem = ContactProblem(
    a,
    0,
    bcs=bcs,
    contacts=bond,
    cell_tags=bodies.cell_tags,
    options={"units": "mm-N-MPa", "rtol": 1e-5, "preconditioner": "dirichlet"},
)


def tell(line):
    """Print on one rank."""
    if comm.rank == 0:
        print(line, flush=True)


# ## Opening and closing
#
# Steps of the opening, back to its half, where nothing more is damaged, and on. Of steps in which
# the crack grows all equilibria on the way are drawn: each has a factor, by which the loads of the
# step are multiplied, and reactions.

curve, spent = [(0.0, 0.0)], 0.0
openings = [2.0, 4.0, *np.arange(5.0, 6.6, 0.25), 3.25, *np.arange(6.5, 8.1, 0.5)]
(number,) = map(int, sys.argv[1:] or (len(openings),))
openings = openings[:number]
for opening in openings:
    for sign, tip in zip((-0.5, 0.5), tips, strict=True):
        tip.x.array[:] = sign * opening
    problem.solve()
    report = problem.report
    damage = report.damage
    steps = [(step.factor * opening, step.reactions[2][1]) for step in damage.path]
    curve += steps or [(opening, report.reactions[2].force[1])]
    spent += damage.dissipated["bond"]
    problem.advance()
    tell(
        f"{opening:.2f} mm: {width * curve[-1][1]:6.2f} N, {damage.failed['bond']:2d} bonds "
        f"failed, {width * spent:5.1f} mJ; {damage.passes:2d} solves, {damage.products} products"
    )
curve = np.array(curve)
curve[:, 1] *= width

# ## Beam theory

ratio = 1.18 * np.sqrt(E1 * E2) / G12
chi = np.sqrt(E1 / (11 * G12) * (3 - 2 * (ratio / (1 + ratio)) ** 2))
arm = np.linspace(crack, 70, 100) + chi * h
EI = E1 * width * h**3 / 12
load = np.sqrt(energy * width * EI) / arm
opened = 2 * load * arm**3 / (3 * EI)
peak = curve[curve[:, 1].argmax()]
tell(f"largest load {peak[1]:.1f} N at {peak[0]:.2f} mm")
tell(f"beam theory  {load[0]:.1f} N at {opened[0]:.2f} mm")

shown = opened < curve[-1, 0]
draw_profile(
    results / "delaminating_beam_load.png",
    {
        "beam theory": ([0, *opened[shown]], [0, *load[shown]], "--"),
        "published peak": ([5.7], [167.0], "s"),
        "bond that breaks": (curve[:, 0], curve[:, 1], ".-"),
    },
    xlabel="opening [mm]",
    ylabel="load [N]",
    title="Double cantilever beam of laminate",
)
draw_deformed(
    results / "delaminating_beam.png",
    problem.u,
    contact_fields(V, problem.results).damage,
    title=f"Damage of the bond between the arms, opened by {openings[-1]:.1f} mm",
    units="mm-N-MPa",
    scale=1,
)
