r"""A half ring of rubber is pressed into a block and dragged along it, with friction.

# Ironing

A die, half a ring, stands on a softer block. Its ends are moved down by a third of the block's
height, then along the block by two of its radii. Strains are finite, the die slides by
many elements, and Coulomb's law with the coefficient of friction 0.3 holds on the surfaces as they
are deformed. The die sticks at first and bends; then it slides, and the force that drags it stays
about constant. It is more than friction would take of a rigid die on a rigid block, since the die
climbs the bulge in front of it.

In each step, the work of the ends is stored in the bodies or dissipated by friction,

$$\int R \cdot \mathrm{d} \bar u = \Delta \int W \, \mathrm{d} x + D,$$

with the reaction R, the prescribed motion $\bar u$ and the strain energy density W.

This demo illustrates how to

- take the strain energy of a neo-Hookean material to a problem of contact;
- prescribe a motion that changes from load step to load step;
- check the balance of energy with friction.

Run it by `python demos/ironing.py`, or on several processes by `mpirun -n 2 python
demos/ironing.py`; it draws pictures into `results/`. A number of load steps, such as 4, may be
given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, Coulomb, NonlinearContactProblem
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    piecewise_constant,
    tag_facets,
    von_mises,
)
from fenics_tfeti.models import neo_hookean, neo_hookean_stress

results = Path("results")
comm = MPI.COMM_WORLD

# ## Bodies
#
# The block, and a box far from it that is bent to the half ring.

mm = 1e-3
pressed, dragged = 3 * mm, 12 * mm
block = Box((0, 0), (40 * mm, 10 * mm), (40, 10))
strip = Box((100 * mm, 0), (110 * mm, 10 * mm), (20, 3))
bodies = boxes(comm, [block, strip], "quadrilateral")
mesh, BASE, TOP, DIE, ENDS = bodies.mesh, 1, 2, 3, 4
surfaces = [
    (BASE, lambda x: np.isclose(x[1], 0), 1),
    (TOP, lambda x: np.isclose(x[1], 10 * mm), 1),
    (DIE, lambda x: np.isclose(x[1], 10 * mm), 2),
    (ENDS, lambda x: np.isclose(x[0], 100 * mm) | np.isclose(x[0], 110 * mm), 2),
]
facet_tags = tag_facets(mesh, surfaces, bodies.cell_tags)
x = mesh.geometry.x
die = x[:, 0] > 90 * mm
angle, radius = np.pi * (x[die, 0] / mm - 90) / 10, 3 * mm + 0.3 * x[die, 1]
x[die, 0], x[die, 1] = 9 * mm + radius * np.cos(angle), 16 * mm + radius * np.sin(angle)

# ## Problem
#
# The residual is the derivative of the strain energy. The die is three times as stiff as the block.

V = displacement_space(mesh)
u, motion = fem.Function(V), fem.Function(V)
E, nu = piecewise_constant(mesh, bodies.cell_tags, {1: 2e6, 2: 6e6}), 0.3
energy = neo_hookean(E, nu)(u) * ufl.dx
F = ufl.derivative(energy, u, ufl.TestFunction(V))
base, ends = (fem.locate_dofs_topological(V, 1, facet_tags.find(tag)) for tag in (BASE, ENDS))
problem = NonlinearContactProblem(
    F,
    u,
    bcs=[fem.dirichletbc(np.zeros(2), base, V), fem.dirichletbc(motion, ends)],
    contacts=[ContactPair(facet_tags, slave=DIE, master=TOP, friction=Coulomb(0.3))],
)

# ## Load steps
#
# Two to press, four to drag, which are shorter while the die sticks.

stored = fem.form(energy)
way, reaction, energies, dissipated, newton = [], [], [], [], []
parts = [0, 0.1, 0.3, 0.6, 1]
(steps,) = map(int, sys.argv[1:] or [6])
path = [(0, -0.5 * pressed), *((part * dragged, -pressed) for part in parts)]
for displacement in path[:steps]:
    motion.x.array.reshape(-1, 2)[:] = displacement
    problem.solve()
    problem.advance()
    way.append(displacement[0])
    reaction.append(problem.report.reactions[1].force)
    energies.append(comm.allreduce(fem.assemble_scalar(stored)))
    dissipated.append(problem.results[0].friction_work)
    newton += problem.report.newton

# ## Balance of energy
#
# From the end of pressing on, by the trapezoidal rule.

R, dragging = np.array(reaction), slice(1, None)
H, N = R[dragging, 0], -R[dragging, 1]
work = np.sum(0.5 * (H[1:] + H[:-1]) * np.diff(way[dragging]))
gained, friction = energies[-1] - energies[1], sum(dissipated[2:])
if comm.rank == 0:
    products = np.mean([step.products for step in newton])
    print(f"{len(newton)} Newton steps in {len(way)} load steps, {products:.0f} products in each")
    print(f"drag {H[-1]:.0f} N/m under {N[-1]:.0f} N/m, ratio {H[-1] / N[-1]:.3f}, mu 0.3")
    print(
        f"work of dragging {work:.3f} J/m, friction and stored energy {friction + gained:.3f} J/m"
    )

# ## Pictures

draw_deformed(
    results / "ironing.png",
    u,
    von_mises(mesh, neo_hookean_stress(E, nu)(u)),
    label="von Mises stress",
    unit="kPa",
    title="A die is dragged over a block, with friction",
    scale=1,
)
draw_profile(
    results / "ironing_force.png",
    {
        "drag": (np.array(way[dragging]) / mm, 1e-3 * H, "o-"),
        "0.3 × pressing force": (np.array(way[dragging]) / mm, 0.3e-3 * N, "--"),
    },
    xlabel="travel of the die [mm]",
    ylabel="force [kN/m]",
    title="Drag of the die",
)
