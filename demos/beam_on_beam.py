r"""A beam is lowered on another one: both bend by many times their thickness, and slide.

# Beam on beam

Two cantilevers of rubber reach over each other from both sides. The clamp of the upper one is moved
down until both are bent by half a right angle. The beams slide along each other, and touch where
one of them ends. There is no friction, so the work of the clamp is the energy that the beams store,

$$\int N \, \mathrm{d} s = \int W \, \mathrm{d} x.$$

While deflections are small the two are like one beam that is clamped at both ends, without a moment
in its middle: with the travel s after the gap is closed, the bending stiffness D and half the
distance a of the clamps, N = 3 D s / (2 a^3). Later the force falls, since the beams slide off each
other.

This demo illustrates how to

- find where bodies touch that are far apart at first;
- let the problem choose its load steps;
- compare with linear theory where it holds.

Run it by `python demos/beam_on_beam.py`, or on several processes by
`mpirun -n 2 python demos/beam_on_beam.py`; it draws pictures into `results/`. A travel of the
clamp in mm, such as 9, may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.interpolate import CubicSpline

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, NonlinearContactProblem
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
    von_mises,
)
from fenics_tfeti.models import neo_hookean, neo_hookean_stress

results = Path("results")
comm = MPI.COMM_WORLD

# ## Bodies
#
# Beams of length 100 mm and thickness 6 mm, of which 60 mm are above each other.

mm = 1e-3
E, nu = 1e7, 0.3
length, t, overlap, gap = 100 * mm, 6 * mm, 60 * mm, 1 * mm
(drop,) = (float(s) * mm for s in sys.argv[1:] or [90])
lower = Box((0, 0), (length, t), (40, 2), "lower")
upper = Box((length - overlap, t + gap), (2 * length - overlap, 2 * t + gap), (34, 2), "upper")
beams = boxes(comm, [lower, upper], "quadrilateral")
mesh, ABOVE, BELOW, FIXED, MOVED = beams.mesh, 1, 2, 3, 4
surfaces = [
    (ABOVE, lambda x: np.isclose(x[1], t), 1),
    (BELOW, lambda x: np.isclose(x[1], t + gap), 2),
    (FIXED, lambda x: np.isclose(x[0], 0), 1),
    (MOVED, lambda x: np.isclose(x[0], 2 * length - overlap), 2),
]
facet_tags = tag_facets(mesh, surfaces, beams.cell_tags)

# ## Problem

V = displacement_space(mesh, 2)
u, motion = fem.Function(V), fem.Function(V)
energy = neo_hookean(E, nu)(u) * ufl.dx(metadata={"quadrature_degree": 4})
fixed, moved = (fem.locate_dofs_topological(V, 1, facet_tags.find(tag)) for tag in (FIXED, MOVED))
problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=[fem.dirichletbc(np.zeros(2), fixed, V), fem.dirichletbc(motion, moved)],
    contacts=[ContactPair(facet_tags, slave=BELOW, master=ABOVE)],
)
stored = fem.form(energy)


def set_load(s):
    """Move the clamp of the upper beam down by s."""
    motion.x.array.reshape(-1, 2)[:, 1] = -s


# ## Load steps
#
# A step after two easy ones is twice as long.

way, force, energies, newton = [gap], [0.0], [0.0], []
for s in problem.steps(set_load, 0.0, drop, first=4.5 * mm):
    way.append(s)
    force.append(problem.results[0].force[1])
    energies.append(comm.allreduce(fem.assemble_scalar(stored)))
    newton += problem.report.newton

# ## Small deflections, and the balance of energy
#
# The curve of the force is a spline through the steps.

D = E / (1 - nu**2) * t**3 / 12
a = length - overlap / 2
linear = 3 * D / (2 * a**3) * (np.array(way) - gap)
work = float(CubicSpline(way, force).integrate(gap, drop))
if comm.rank == 0:
    products = np.mean([step.products for step in newton])
    print(
        f"{len(newton)} Newton steps in {len(way) - 1} load steps, {products:.0f} products in each"
    )
    print(f"force at {way[1] / mm:.1f} mm {force[1]:.3f} N/m, beam theory {linear[1]:.3f} N/m")
    print(f"work of the clamp {work:.3f} J/m, energy stored {energies[-1]:.3f} J/m")

# ## Pictures

draw_deformed(
    results / "beam_on_beam.png",
    u,
    von_mises(mesh, neo_hookean_stress(E, nu)(u)),
    label="von Mises stress",
    unit="kPa",
    title="Two beams lie on each other",
    scale=1,
)
draw_profile(
    results / "beam_on_beam_force.png",
    {
        "beam theory, small deflections": (np.array(way) / mm, linear, "--"),
        "finite strains": (np.array(way) / mm, force, "o-"),
    },
    xlabel="travel of the clamp [mm]",
    ylabel="force [N/m]",
    title="A beam is lowered on another one",
)
