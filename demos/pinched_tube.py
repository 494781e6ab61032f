r"""A rubber tube is pinched between two bars until its inner walls press on each other.

# Pinched tube

A tube is closed by two round bars, as a hose is in a pinch valve. Its inner wall is one surface, of
which nobody knows in advance where it will meet itself: upper and lower half face each other more
and more while the tube flattens. They touch when the bars are 2 t apart, for walls of the thickness
t; from then on the force of the bars rises steeply. By symmetry half of the tube is computed.

This demo illustrates how to

- let a wall touch itself at finite strains;
- press with rigid bars that move;
- make an animation of load steps from pictures.

Run it by `python demos/pinched_tube.py`, or on several processes by
`mpirun -n 2 python demos/pinched_tube.py`; it draws pictures and an animation into `results/`. A
part of the height of the tube to be closed, such as 0.5, may be given. All units are SI, forces are
per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, RigidObstacle, SelfContact, Sphere
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_profile,
    tag_facets,
    von_mises,
    write_gif,
)
from fenics_tfeti.models import neo_hookean, neo_hookean_stress, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Half a tube
#
# A box that is bent, with displacements of degree 2.

E, nu = 1e6, 0.3
R, t, bar = 50e-3, 6e-3, 20e-3
UPPER, LOWER, CUT, INSIDE = 1, 2, 3, 4
mesh = boxes(comm, [Box((0, -t / 2), (np.pi, t / 2), (60, 3))], "quadrilateral").mesh
markers = {
    UPPER: lambda x: np.isclose(x[1], t / 2) & (x[0] < np.pi / 2 + 1e-6),
    LOWER: lambda x: np.isclose(x[1], t / 2) & (x[0] > np.pi / 2 - 1e-6),
    CUT: lambda x: np.isclose(x[0], 0) | np.isclose(x[0], np.pi),
    INSIDE: lambda x: np.isclose(x[1], -t / 2),
}
facet_tags = tag_facets(mesh, markers)
angle, radius = mesh.geometry.x[:, 0].copy(), R + mesh.geometry.x[:, 1]
mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.sin(angle), radius * np.cos(angle)

# ## Problem
#
# The bars are functions of how far they have closed the tube. The wall inside may touch itself.

V = displacement_space(mesh, 2)
u = fem.Function(V)
energy = neo_hookean(E, nu)(u) * ufl.dx(metadata={"quadrature_degree": 4})
closed = {"part": 0.0}


def bar_at(side):
    """Return the obstacle above (1) or below (-1) the tube, where it is now."""

    def gap(x):
        height = R + t / 2 + bar - closed["part"] * R
        return Sphere((0, side * height), bar)(x)

    return gap


above, below = bar_at(1), bar_at(-1)
problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=[symmetry_plane(V, facet_tags, CUT, 0)],
    contacts=[
        RigidObstacle(facet_tags, UPPER, above, name="upper bar"),
        RigidObstacle(facet_tags, LOWER, below, name="lower bar"),
        SelfContact(facet_tags, INSIDE, name="wall"),
    ],
)

# ## Load steps
#
# Ever shorter ones, to where the walls are squeezed between the bars. Forces of half a tube are
# doubled.

(end,) = map(float, sys.argv[1:] or [0.97])
parts = [*np.arange(0.1, 0.85, 0.1), *np.arange(0.85, 0.92, 0.02), *np.arange(0.92, 0.975, 0.01)]
way, force, walls, pictures, newton = [0.0], [0.0], [0.0], [], 0


def draw(path, part):
    """Draw the tube, closed by a part of its height."""
    problem.draw(
        path,
        von_mises(mesh, neo_hookean_stress(E, nu)(u)),
        label="von Mises stress",
        unit="kPa",
        title=f"Half of a tube, closed by {part:.0%}",
        limits=(0, 500),
    )


for part in [part for part in parts if part < end + 1e-9]:
    closed["part"] = part
    problem.solve()
    problem.advance()
    way.append(part)
    force.append(-2 * problem.results["upper bar"].force[1])
    walls.append(2 * abs(problem.results["wall"].force[1]))
    newton += len(problem.report.newton)
    pictures.append(results / "pinched_tube" / f"{len(pictures):02}.png")
    draw(pictures[-1], part)

depth = problem.report.contacts[2].penetration
if comm.rank == 0:
    print(f"{newton} Newton steps in {len(pictures)} load steps")
    print(
        f"closed by {way[-1]:.0%}: bars {force[-1]:.4g} N/m, between the walls {walls[-1]:.4g} N/m"
    )
    print(f"nodes are inside the other wall by {depth:.1e} m")

# ## Animation, and the forces

write_gif(results / "pinched_tube.gif", pictures)
draw(results / "pinched_tube.png", way[-1])
draw_profile(
    results / "pinched_tube_force.png",
    {"bars": (way, force, "o-"), "between the walls": (way, walls, "o-")},
    xlabel="closed part of the height",
    ylabel="force [N/m]",
    title="A tube, pinched until its walls meet",
)
