r"""A coil spring is pressed until its coils close: one surface meets itself, turn by turn.

# Coil spring

A die spring of square wire is pressed together. At first its wire is twisted, and the force grows
in proportion. When the coils close they press on each other, and the spring is solid. Nobody has
tagged where: the whole side of the wire is one surface that may touch itself.

For a wire with the edge a, the radius R of the coils and n turns between clamped ends, Saint
Venant's torsion of a square bar gives

$$F = \frac{0.1406 \, G a^4}{2 \pi n R^3} \, s$$

at the travel s. It leaves out shear, and that the wire is curved and inclined.

This demo illustrates how to

- let a surface in space touch itself;
- make an animation of load steps from pictures.

Run it by `python demos/coil_spring.py`, or on several processes by
`mpirun -n 2 python demos/coil_spring.py`; it draws pictures and an animation into `results/`. A
part of the free travel, such as 0.5, may be given. All units are SI.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, SelfContact
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_profile,
    tag_facets,
    von_mises,
    write_gif,
)
from fenics_tfeti.models import neo_hookean, neo_hookean_stress

results = Path("results")
comm = MPI.COMM_WORLD

# ## The wire
#
# A bar that is wound up, with displacements of degree 2.

mm = 1e-3
E, nu = 206e9, 0.3
turns, R, edge, pitch = 2.5, 10 * mm, 3 * mm, 5 * mm
BOTTOM, TOP, SIDE = 1, 2, 3
bar = Box((0, -edge / 2, -edge / 2), (1, edge / 2, edge / 2), (round(16 * turns), 2, 2))
mesh = boxes(comm, [bar], "hexahedron").mesh
markers = {
    BOTTOM: lambda x: np.isclose(x[0], 0),
    TOP: lambda x: np.isclose(x[0], 1),
    SIDE: lambda x: np.isclose(np.abs(x[1:]).max(axis=0), edge / 2),
}
facet_tags = tag_facets(mesh, markers)
along, across, up = mesh.geometry.x.T.copy()
angle, radius = 2 * np.pi * turns * along, R + across
mesh.geometry.x[:] = np.stack(
    [radius * np.cos(angle), radius * np.sin(angle), up + pitch * turns * along], axis=1
)

# ## Problem
#
# Both ends of the wire are clamped, the upper one moves down.

V = displacement_space(mesh, 2)
u, motion = fem.Function(V), fem.Function(V)
energy = neo_hookean(E, nu)(u) * ufl.dx(metadata={"quadrature_degree": 4})
ends = [fem.locate_dofs_topological(V, 2, facet_tags.find(tag)) for tag in (BOTTOM, TOP)]
bcs = [fem.dirichletbc(fem.Function(V), ends[0]), fem.dirichletbc(motion, ends[1])]
problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=bcs,
    contacts=[SelfContact(facet_tags, SIDE, name="coils")],
)

# ## Load steps
#
# Up to a little more than the travel that is free between the coils, each with a picture.

(part,) = map(float, sys.argv[1:] or [1.2])
free = (pitch - edge) * turns
travel, force, pictures, newton = [0.0], [0.0], [], 0


def draw(path, step):
    """Draw the spring, pressed by a step [m]."""
    problem.draw(
        path,
        von_mises(mesh, neo_hookean_stress(E, nu)(u)),
        label="von Mises stress",
        unit="MPa",
        title=f"A coil spring, pressed by {step / mm:.1f} mm",
        limits=(0, 1500),
    )


for step in np.arange(0.1, part + 0.01, 0.1) * free:
    motion.x.array.reshape(-1, 3)[:, 2] = -step
    problem.solve()
    problem.advance()
    travel.append(step)
    force.append(problem.report.reactions[0].force[2])
    newton += len(problem.report.newton)
    pictures.append(results / "coil_spring" / f"{len(pictures):02}.png")
    draw(pictures[-1], step)

G = E / (2 * (1 + nu))
rate = 0.1406 * G * edge**4 / (2 * np.pi * turns * R**3)
pressing = comm.allreduce(int(problem.results["coils"].active.sum()))
if comm.rank == 0:
    print(f"{newton} Newton steps in {len(force) - 1} load steps")
    print(f"rate {force[1] / travel[1] * mm:.1f} N/mm, by the formula {rate * mm:.1f} N/mm")
    print(f"force at {travel[-1] / mm:.1f} mm {force[-1]:.0f} N, {pressing} nodes press on coils")

# ## Animation, and the force over the travel

write_gif(results / "coil_spring.gif", pictures)
draw(results / "coil_spring.png", travel[-1])
way = np.array(travel) / mm
draw_profile(
    results / "coil_spring_force.png",
    {
        "torsion of a square bar": (way, rate * way * mm, "-"),
        "finite strains and contact": (way, force, "o-"),
    },
    xlabel="travel [mm]",
    ylabel="force [N]",
    title="A coil spring, pressed until it is solid",
)
