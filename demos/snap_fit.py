r"""A clip bends over a bump and clicks in behind it, with friction.

# Snap-fit

A cantilever of plastic with a rounded hook at its end is pushed along a stiff rail that has a bump.
The hook climbs the bump, the cantilever bends, and behind the top the hook slides down by itself:
the force changes its sign. Rotations and sliding are large; the coefficient of friction is 0.2.

The work of the hand is stored in the bodies or dissipated by friction,

$$\int H \, \mathrm{d} s = \int W \, \mathrm{d} x + D.$$

Behind the bump the clip is free of stress again: all of the work is dissipated.

This demo illustrates how to

- move a support in load steps;
- get the force of a support from the report;
- measure what friction dissipates;
- make an animation of a run.

Run it by `python demos/snap_fit.py`, or on several processes by `mpirun -n 2 python
demos/snap_fit.py`; it draws pictures and an animation into `results/`. A travel of the clip in mm,
such as 0.6, may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

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
# Two boxes whose facing sides get a bump, half a wave of a cosine squared. The hook is at the end
# of the clip, and its middle 2.1 mm before that of the rail. Cells are shorter at the hook.

mm = 1e-3
arm, thickness, bump, half = 18 * mm, 1.2 * mm, 1 * mm, 2 * mm
gap, start = 1.02 * mm, 2.1 * mm
clip = Box((-24, gap), (40, gap + thickness), (64, 4), "clip")
rail = Box((start - half, -2 * mm), (start + 3 * half, 0), (72, 4), "rail")
bodies = boxes(comm, [clip, rail], "quadrilateral")
mesh, CLIP, RAIL, GRIP, BASE = bodies.mesh, 1, 2, 3, 4
surfaces = [
    (CLIP, lambda x: np.isclose(x[1], gap) & (x[0] > -1), 1),
    (RAIL, lambda x: np.isclose(x[1], 0), 2),
    (GRIP, lambda x: np.isclose(x[0], -24), 1),
    (BASE, lambda x: np.isclose(x[1], -2 * mm), 2),
]
facet_tags = tag_facets(mesh, surfaces, bodies.cell_tags)


def raised(x, middle):
    """Return the height of a bump."""
    wave = np.cos(np.pi / 2 * np.clip((x - middle) / half, -1, 1))
    return bump * wave**2


x = mesh.geometry.x
of_clip = x[:, 1] > 0.5 * gap
cells = x[of_clip, 0]
x[of_clip, 0] = np.where(cells < 0, arm / 24 * cells, half / 20 * cells) - half
x[of_clip, 1] -= (gap + thickness - x[of_clip, 1]) / thickness * raised(x[of_clip, 0], 0)
x[~of_clip, 1] += (x[~of_clip, 1] / (2 * mm) + 1) * raised(x[~of_clip, 0], start)

# ## Problem
#
# The clip of a plastic, the rail of aluminium.

V = displacement_space(mesh)
u, motion = fem.Function(V), fem.Function(V)
E, nu = piecewise_constant(mesh, bodies.cell_tags, {1: 2e9, 2: 7e10}), 0.35
energy = neo_hookean(E, nu)(u) * ufl.dx
grip, base = (fem.locate_dofs_topological(V, 1, facet_tags.find(tag)) for tag in (GRIP, BASE))
problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=[fem.dirichletbc(motion, grip), fem.dirichletbc(np.zeros(2), base, V)],
    contacts=[ContactPair(facet_tags, slave=CLIP, master=RAIL, friction=Coulomb(0.2))],
)
stored = fem.form(energy)

# ## Load steps
#
# They are no longer than the facets of the hook: slip is counted along a line in each step. Every
# second one is a frame of the animation.

owned = mesh.topology.index_map(2).size_local
corners = np.array([V.dofmap.cell_dofs(cell)[[0, 1, 3, 2]] for cell in range(owned)])


def frame():
    """Return the corners (m, 4, 2) [mm] and stresses (m,) [MPa] of the cells of all ranks."""
    places = V.tabulate_dof_coordinates()[:, :2] + u.x.array.reshape(-1, 2)
    stress = von_mises(mesh, neo_hookean_stress(E, nu)(u)).x.array[:owned]
    ranks = comm.allgather((places[corners] / mm, 1e-6 * stress))
    return [np.concatenate(part) for part in zip(*ranks, strict=True)]


frames = [frame()]
way, force, dissipated, newton = [0.0], [0.0], [0.0], []
(travel,) = map(float, sys.argv[1:] or [4.2])  # mm
for s in 0.1 * mm * np.arange(1, round(10 * travel) + 1):
    motion.x.array.reshape(-1, 2)[:, 0] = s
    problem.solve()
    problem.advance()
    way.append(s)
    force.append(problem.report.reactions[0].force[0])
    dissipated.append(problem.results[0].friction_work)
    newton += problem.report.newton
    if len(way) % 2:
        frames.append(frame())
    if np.isclose(s, 1.5 * mm):
        draw_deformed(
            results / "snap_fit.png",
            u,
            von_mises(mesh, neo_hookean_stress(E, nu)(u)),
            label="von Mises stress",
            unit="MPa",
            title="A clip climbs the bump of its rail",
            scale=1,
        )

# ## Balance of energy
#
# By the trapezoidal rule.

H = np.array(force)
work, friction = np.sum(0.5 * (H[1:] + H[:-1]) * np.diff(way)), sum(dissipated)
left = comm.allreduce(fem.assemble_scalar(stored))
if comm.rank == 0:
    products = np.mean([step.products for step in newton])
    print(
        f"{len(newton)} Newton steps in {len(way) - 1} load steps, {products:.0f} products in each"
    )
    print(f"push at most {H.max():.0f} N/m, pull of the click {-H.min():.0f} N/m")
    print(f"work {work:.4f} J/m, friction {friction:.4f} J/m")

# ## The force over the travel

draw_profile(
    results / "snap_fit_force.png",
    {"hand": (np.array(way) / mm, H, "o-")},
    xlabel="travel of the clip [mm]",
    ylabel="force [N/m]",
    title="A clip is pushed over a bump, and clicks in",
)

# ## Animation
#
# The bodies, and below them the force up to each frame.

if comm.rank == 0:
    figure = Figure(figsize=(7, 4.2), dpi=100, layout="constrained")
    above, below = figure.subplots(2, height_ratios=(1, 0.9))
    x, most = np.concatenate([places for places, _ in frames]), max(s.max() for _, s in frames)
    low, high = x.min(axis=(0, 1)) - 0.5, x.max(axis=(0, 1)) + 0.5
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    above.axis("off")
    drawn = PolyCollection(frames[0][0], cmap="YlOrRd", edgecolor="#22262b40", linewidth=0.3)
    drawn.set_clim(0.0, most)
    above.add_collection(drawn)
    figure.colorbar(drawn, ax=above, label="von Mises [MPa]")
    below.set(xlim=(0, way[-1] / mm), ylim=(1.1 * H.min(), 1.1 * H.max()))
    below.set(xlabel="travel of the clip [mm]", ylabel="force [N/m]")
    below.axhline(0.0, color="#d5d8dc")
    (curve,) = below.plot([], [], "o-", markevery=[-1])

    def show(number):
        """Show one frame."""
        places, stress = frames[number]
        drawn.set_verts(places)
        drawn.set_array(stress)
        done = slice(0, 2 * number + 1)
        curve.set_data(np.array(way[done]) / mm, H[done])

    animation = FuncAnimation(figure, show, len(frames))
    animation.save(results / "snap_fit.gif", writer="pillow", fps=8)
