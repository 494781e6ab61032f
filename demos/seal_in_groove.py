r"""A rubber seal is squeezed into its groove at finite strains: Poisson's ratio 0.499.

# Seal in a groove

A strip of rubber with a round crown is bonded to the floor of a groove in a stiff housing, and a
lid is moved down on it. The crown is flattened and the rubber, which keeps its volume, moves to the
walls. The more of the groove it fills, the stiffer it gets. Lid and walls are lubricated.

The material is neo-Hookean. Its volumetric energy is integrated by one point of each cell, so that
the cells do not lock, as in the demo of small strains. Without friction the work of the lid is what
the rubber stores,

$$\int N \, \mathrm{d} s = \int W \, \mathrm{d} x.$$

This demo illustrates how to

- write the energy of a nearly incompressible material;
- let the problem choose its load steps;
- get from one contact to the pressure along a wall.

Run it by `python demos/seal_in_groove.py`, or on several processes by
`mpirun -n 2 python demos/seal_in_groove.py`; it draws pictures into `results/`. A squeeze in
mm, such as 0.2, may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.interpolate import CubicSpline

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, NonlinearContactProblem, TiedPair
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
from fenics_tfeti.models import neo_hookean_stress

results = Path("results")
comm = MPI.COMM_WORLD

# ## Bodies
#
# The seal is a box whose upper face is raised to a parabola. The groove is of three boxes.

mm = 1e-3
w, h, crown = 5 * mm, 3 * mm, 1.5 * mm  # of the seal
half, depth, t = 3 * mm, 3.5 * mm, 1.5 * mm  # of the groove; thickness of its walls
(squeeze,) = (float(s) * mm for s in sys.argv[1:] or [1])
parts = [
    Box((-w / 2, 0), (w / 2, h), (14, 10), "seal"),
    Box((-half - t, -t), (half + t, 0), (14, 2), "floor"),
    Box((-half - t, 0), (-half, depth), (2, 6), "left"),
    Box((half, 0), (half + t, depth), (2, 6), "right"),
    Box((-half - t, h + crown), (half + t, h + crown + t), (14, 2), "lid"),
]
bodies = boxes(comm, parts, "quadrilateral")
mesh, SEAL, OTHER, FIXED, MOVED = bodies.mesh, 10, 20, 30, 31
lid_at = h + crown
surfaces = [
    (SEAL, lambda x: np.isclose(x[1], 0), 1),
    (SEAL + 1, lambda x: np.isclose(x[0], -w / 2), 1),
    (SEAL + 2, lambda x: np.isclose(x[0], w / 2), 1),
    (SEAL + 3, lambda x: np.isclose(x[1], h), 1),
    (OTHER, lambda x: np.isclose(x[1], 0), 2),
    (OTHER + 1, lambda x: np.isclose(x[0], -half), 3),
    (OTHER + 2, lambda x: np.isclose(x[0], half), 4),
    (OTHER + 3, lambda x: np.isclose(x[1], lid_at), 5),
    (FIXED, lambda x: np.isclose(x[1], -t), 2),
    (FIXED, lambda x: np.isclose(x[0], -half - t), 3),
    (FIXED, lambda x: np.isclose(x[0], half + t), 4),
    (MOVED, lambda x: np.isclose(x[1], lid_at + t), 5),
]
facet_tags = tag_facets(mesh, surfaces, bodies.cell_tags)
x = mesh.geometry.x
of_seal = (np.abs(x[:, 0]) < half - 0.1 * mm) & (x[:, 1] > 0) & (x[:, 1] < h + 0.1 * mm)
x[of_seal, 1] *= 1 + crown / h * (1 - (2 * x[of_seal, 0] / w) ** 2)

# ## Energy
#
# The term with the trace resists shear, that with the logarithm changes of volume.

V = displacement_space(mesh)
u, motion = fem.Function(V), fem.Function(V)
E = piecewise_constant(mesh, bodies.cell_tags, {1: 6e6, 2: 2e9, 3: 2e9, 4: 2e9, 5: 2e9})
nu = piecewise_constant(mesh, bodies.cell_tags, {1: 0.499, 2: 0.3, 3: 0.3, 4: 0.3, 5: 0.3})
mu, lmbda = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
gradient = ufl.Identity(2) + ufl.grad(u)
log = ufl.ln(ufl.det(gradient))
one_point = ufl.dx(metadata={"quadrature_degree": 0})
shear = mu / 2 * (ufl.inner(gradient, gradient) - 2 - 2 * log) * ufl.dx
volume = lmbda / 2 * log**2 * one_point

# ## Problem

fixed, moved = (fem.locate_dofs_topological(V, 1, facet_tags.find(tag)) for tag in (FIXED, MOVED))
contacts = [TiedPair(facet_tags, slave=SEAL, master=OTHER, name="floor")]
for i, name in enumerate(("left wall", "right wall", "lid"), start=1):
    contacts.append(ContactPair(facet_tags, slave=SEAL + i, master=OTHER + i, name=name))
problem = NonlinearContactProblem(
    ufl.derivative(shear + volume, u, ufl.TestFunction(V)),
    u,
    bcs=[fem.dirichletbc(np.zeros(2), fixed, V), fem.dirichletbc(motion, moved)],
    contacts=contacts,
    options={"newton_rtol": 1e-8},
)
# terms with different quadrature rules in forms of their own, which FFCx 0.5 mixes in one
stored = [fem.form(term) for term in (shear, volume)]


def set_load(s):
    """Move the lid down by s."""
    motion.x.array.reshape(-1, 2)[:, 1] = -s


# ## Load steps
#
# A step after two easy ones is twice as long, one that does not converge is halved.

way, force, energies, newton = [0.0], [0.0], [0.0], []
for s in problem.steps(set_load, 0.0, squeeze, first=0.05 * mm):
    way.append(s)
    force.append(abs(problem.results["lid"].force[1]))
    energies.append(comm.allreduce(sum(map(fem.assemble_scalar, stored))))
    newton += problem.report.newton

# ## Balance of energy
#
# The curve of the force is a spline through the steps.

work = float(CubicSpline(way, force).integrate(0.0, squeeze))
wall = problem.results["left wall"].gather()
if comm.rank == 0:
    products = np.mean([step.products for step in newton])
    print(
        f"{len(newton)} Newton steps in {len(way) - 1} load steps, {products:.0f} products in each"
    )
    p = 1e-6 * wall.pressure.max()
    print(f"lid {1e-3 * force[-1]:.2f} kN/m, largest pressure on a wall {p:.2f} MPa")
    print(f"work of the lid {work:.3f} J/m, energy stored {energies[-1]:.3f} J/m")

# ## Pictures
#
# The stress of the housing is left out.

stress = von_mises(mesh, neo_hookean_stress(E, nu)(u))
stress.x.array[E.x.array > 1e9] = 0.0
draw_deformed(
    results / "seal_in_groove.png",
    u,
    stress,
    label="von Mises stress of the rubber",
    unit="MPa",
    title="A rubber seal fills its groove",
    scale=1,
)
draw_profile(
    results / "seal_in_groove_force.png",
    {"lid": (np.array(way) / mm, 1e-3 * np.array(force), "o-")},
    xlabel="squeeze [mm]",
    ylabel="force of the lid [kN/m]",
    title="Force that squeezes a seal into its groove",
)
