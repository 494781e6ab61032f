r"""A rigid flat punch on an elastic half space: the pressure is singular at the edge.

# Flat punch

A rigid punch with a flat end of radius a = 10 mm is pushed by delta = 0.1 mm into a half space. The
pressure is singular at the edge. Under a circular punch force and pressure are

$$F = 2 a E^* \delta, \quad p(r) = \frac{F}{2 \pi a \sqrt{a^2 - r^2}}, \quad
E^* = \frac{E}{1 - \nu^2}.$$

Under a long punch of width 2a (plane strain) with the force F' per unit of length it is

$$p(x) = \frac{F'}{\pi \sqrt{a^2 - x^2}}.$$

This demo illustrates how to

- define an obstacle by a function of your own, which returns the gap and the normal at each point;
- prescribe an approach: a negative gap is an obstacle that has moved into the body.

Run it by `python demos/flat_punch.py`, or on several processes by
`mpirun -n 2 python demos/flat_punch.py`; it draws pictures into `results/`. The meshes come
from `meshes/half_space.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidObstacle
from fenics_tfeti.io import displacement_space, draw_profile, read_msh
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# A hard plastic.

a, delta, E, nu = 0.01, 1e-4, 2e9, 0.3
E_star = E / (1 - nu**2)

# ## One solution, in two or three dimensions
#
# Only a half (a quarter) of the body is meshed. The displacement is zero at a distance of 200 a.


def solve(path, gdim):
    """Solve on the mesh of a file; return the problem and the displacement."""
    body = read_msh(path, comm, gdim)
    mesh, facet_tags, tags = body.mesh, body.facet_tags, body.names
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a_form = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx
    far = fem.locate_dofs_topological(V, gdim - 1, facet_tags.find(tags["far"]))
    bcs = [fem.dirichletbc(np.zeros(gdim), far, V)]
    for axis, name in enumerate(("symmetry_x", "symmetry_y")[: gdim - 1]):
        bcs.append(symmetry_plane(V, facet_tags, tags[name], axis))

    # The gap is -delta under the punch. Beside it there is no obstacle: the gap a is larger than
    # any displacement. The normal points from the obstacle to the body, downwards.
    def punch(x):
        r = np.linalg.norm(x[: gdim - 1], axis=0)
        gap = np.where(r < a * (1 + 1e-6), -delta, a)
        normal = np.zeros((gdim, r.size))
        normal[-1] = -1.0
        return gap, normal

    contact = RigidObstacle(facet_tags, slave=tags["top"], obstacle=punch)
    problem = ContactProblem(a_form, 0, bcs=bcs, contacts=[contact])
    return problem, problem.solve()


# ## Comparison with the formulas
#
# All pressures are relative to the mean pressure, F / (pi a^2) and F' / (2 a). Linear elements
# do not resolve the singularity: the force of the node at the edge is too large, that of the next
# node too small. With elements of half the size the errors are three times smaller.

curves, errors = {}, {}
s = np.linspace(0, 0.995, 400)
for name, gdim, style in (("strip", 2, "s"), ("disc", 3, "o")):
    problem, uh = solve(here.parent / "meshes" / f"punch_{name}.msh", gdim)
    contact = problem.results[0].gather()
    r = np.linalg.norm(contact.coordinates[:, : gdim - 1], axis=1) / a
    F = 2 ** (gdim - 1) * problem.report.contacts[0].normal_force
    p = contact.pressure / (F / (np.pi * a**2 if gdim == 3 else 2 * a))
    factor = 1 / 2 if gdim == 3 else 2 / np.pi
    inner = r < 0.75
    errors[name] = np.abs(p[inner] * np.sqrt(1 - r[inner] ** 2) / factor - 1).max()
    if comm.rank == 0:
        products = problem.report.products["total"]
        print(f"{name}: error up to 3/4 a at most {errors[name]:.2%}, {products} iterations")
        if gdim == 3:
            exact = 2 * a * E_star * delta
            print(f"  F = {F:.2f} N, 2 a E* delta = {exact:.2f} N  {F / exact - 1:+.2%}")
    below = r < 0.999
    curves[name] = (r[below], p[below], style)
    curves[f"formula, {name}"] = (s, factor / np.sqrt(1 - s**2), "-")

# ## Pictures

draw_profile(
    results / "flat_punch_pressure.png",
    curves,
    xlabel="distance from the middle / a",
    ylabel="pressure / mean pressure",
    title="Pressure under a flat punch",
)

# The surface sinks by delta under the disc and by 2 delta / pi arcsin(a / r) beside it. The nodes
# on the line y = z = 0 are gathered from all ranks.

V = uh.function_space
nodes = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local]
on_line = np.flatnonzero((np.abs(nodes[:, 1:]) < 1e-9 * a).all(axis=1) & (nodes[:, 0] < 5 * a))
line = np.column_stack([nodes[on_line, 0] / a, 1e3 * uh.x.array.reshape(-1, 3)[on_line, 2]])
x, sinking = np.concatenate(comm.allgather(line)).T
s = np.linspace(0, 5, 400)
formula = -2 * delta / np.pi * np.arcsin(1 / np.maximum(1, s))
draw_profile(
    results / "flat_punch_surface.png",
    {"nodes of the surface": (x, sinking, "o"), "formula": (s, 1e3 * formula, "-")},
    xlabel="distance from the middle / a",
    ylabel="height [mm]",
    title="The surface under a circular punch",
)
