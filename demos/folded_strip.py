r"""A strip with two folds is pressed flat: its sheets touch each other, where nobody tagged them.

# Folded strip

A strip of rubber runs back and forth in three sheets, as in a bellows. A plate presses the upper
sheet down until both gaps are closed, and lets it go again. The whole boundary of the strip is one
surface that may touch itself; which parts of it meet is found while it deforms. Nothing is paired
through a sheet, and each fold has a slave and a master of its own.

Without friction the strip is elastic: on the way back the plate has the same force at each height.

This demo illustrates how to

- let a surface touch itself without tags;
- load and unload.

Run it by `python demos/folded_strip.py`, or on several processes by
`mpirun -n 2 python demos/folded_strip.py`; it draws pictures into `results/`. The number of load
steps down may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, Plane, RigidObstacle, SelfContact
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
    von_mises,
)
from fenics_tfeti.models import neo_hookean, neo_hookean_stress, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Three sheets
#
# A box is laid along a curve of straight legs and half circles.

E, nu = 2e6, 0.4
leg, thick, gap = 60e-3, 5e-3, 2e-3
pitch, height = thick + gap, 2 * (thick + gap) + thick / 2
turn = np.pi * pitch / 2
BOTTOM, TOP = 1, 2
length = 3 * leg + 2 * turn
mesh = boxes(comm, [Box((0, -thick / 2), (length, thick / 2), (84, 2))], "quadrilateral").mesh
markers = {
    BOTTOM: lambda x: np.isclose(x[1], -thick / 2) & (x[0] < leg + 1e-9),
    TOP: lambda x: np.isclose(x[1], thick / 2) & (x[0] > length - leg - 1e-9),
}
facet_tags = tag_facets(mesh, markers)
s, y = mesh.geometry.x[:, :2].T.copy()
sheet = np.minimum(s // (leg + turn), 2)
along = s - sheet * (leg + turn)
angle = np.maximum(along - leg, 0) / (pitch / 2)
forward = np.where(sheet % 2 == 0, 1, -1)
x0 = np.where(sheet % 2 == 0, 0, leg) + forward * (
    np.minimum(along, leg) + pitch / 2 * np.sin(angle)
)
y0 = sheet * pitch + pitch / 2 * (1 - np.cos(angle))
mesh.geometry.x[:, 0] = x0 - y * np.sin(angle)
mesh.geometry.x[:, 1] = y0 + forward * y * np.cos(angle)

# ## Problem
#
# The lower sheet stands on its base. `SelfContact` without tags takes the whole boundary.

V = displacement_space(mesh)
u = fem.Function(V)
energy = neo_hookean(E, nu)(u) * ufl.dx
down = {"now": 0.0}
plate = RigidObstacle(
    facet_tags, TOP, lambda x: Plane((0, height - down["now"]), (0, -1))(x), name="plate"
)
problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=[symmetry_plane(V, facet_tags, BOTTOM, axis) for axis in (0, 1)],
    contacts=[plate, SelfContact(name="strip")],
)

# ## Down and up

(steps,) = map(int, sys.argv[1:] or [8])
way = np.linspace(0, 1.9 * gap, steps + 1)
forces = {0.0: [0.0]}
for now in [*way[1:], *way[-2:0:-1]]:
    down["now"] = now
    problem.solve()
    problem.advance()
    forces.setdefault(now, []).append(-problem.results["plate"].force[1])
    if now == way[-1]:
        pressing = comm.allreduce(int(problem.results["strip"].active.sum()))
        depth = problem.report.contacts[1].penetration
        draw_deformed(
            results / "folded_strip.png",
            u,
            von_mises(mesh, neo_hookean_stress(E, nu)(u)),
            label="von Mises stress",
            unit="MPa",
            title="Three sheets of one strip, pressed",
            scale=1,
        )

loading, unloading = np.array([*forces.values()][1:-1]).T
returned = np.abs(unloading / loading - 1).max()
if comm.rank == 0:
    print(f"{pressing} nodes press on other sheets, depth inside them {depth:.1e} m")
    print(f"force {forces[way[-1]][0]:.0f} N/m, on the way back the same to {returned:.0e}")

draw_profile(
    results / "folded_strip_force.png",
    {
        "down": (1e3 * way[:-1], [0, *loading], "-"),
        "up": (1e3 * way[1:-1], unloading, "o"),
    },
    xlabel="travel of the plate [mm]",
    ylabel="force [N/m]",
    title="A folded strip, pressed and let go",
)
