r"""Two elastic bars that meet: waves run through them, and they exchange their velocities.

# Impact of two bars

A bar moves with velocity v onto an equal one at rest. Waves with the velocity c of sound start at
the contact, in which the pressure is rho c v / 2. They come back from the free ends after the time
2 L / c: the bars part, the first one at rest and the second one with the velocity v.

Newmark's method for such a problem makes contact forces that jump between zero and many times
their value, and energy, where the nodes of the contact have mass. Here they have none
(`redistributed_density`), and the mass is in the next elements.

This demo illustrates how to

- write time steps around a `ContactProblem`: all but the first reuse the factors;
- take the mass away from the contact, and what happens otherwise.

Run it by `python demos/impact_of_bars.py`, or on several processes by
`mpirun -n 2 python demos/impact_of_bars.py`; it draws pictures into `results/`. A number of
elements along a bar other than 30 may be given. All units are SI.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic, redistributed_density, small_strain

comm = MPI.COMM_WORLD

# ## Bars
#
# Bars of steel, 1 m long, with Poisson's ratio zero: the waves are those of one dimension.

(n,) = map(int, sys.argv[1:] or [30])
L, E, rho, v = 1.0, 2.1e11, 7850.0, 1.0
c = (E / rho) ** 0.5
h = L / n
bars = [Box((-L, 0), (0, h), (n, 1)), Box((0, 0), (L, h), (n, 1))]
bodies = boxes(comm, bars, "quadrilateral")
mesh = bodies.mesh
mesh.topology.create_connectivity(2, 2)  # to find nodes of cells
ends = [(body, lambda x: np.isclose(x[0], 0), body) for body in (1, 2)]
contacts = [ContactPair(tag_facets(mesh, ends, bodies.cell_tags), slave=1, master=2)]
V = displacement_space(mesh)
u, w = ufl.TrialFunction(V), ufl.TestFunction(V)
sigma = isotropic(E, 0.0)
dx = ufl.Measure("dx", domain=mesh)

# ## Time steps
#
# Newmark's method with a little damping of the shortest waves (Wood, Bossak and Zienkiewicz). A
# wave takes two steps through an element.

dt, alpha = 0.5 * h / c, -0.05
beta, gamma = (1 - alpha) ** 2 / 4, 1 / 2 - alpha


def acceleration(u, u0, v0, a0):
    """Return the acceleration at the end of a step, from the displacement there."""
    return (u - u0 - dt * v0) / (beta * dt**2) - (1 / (2 * beta) - 1) * a0


def impact(density, steps):
    """Return pressures and energies [J/m] of all steps, and the mean velocities in the end."""
    u0, v0, a0 = (fem.Function(V) for _ in range(3))
    v0.x.array[fem.locate_dofs_topological(V.sub(0), 2, bodies.cell_tags.find(1))] = v
    inertia = density * ((1 - alpha) * acceleration(u, u0, v0, a0) + alpha * a0)
    residual = (ufl.inner(sigma(u), small_strain(w)) + ufl.inner(inertia, w)) * dx
    problem = ContactProblem(ufl.lhs(residual), ufl.rhs(residual), contacts=contacts)
    energy = ufl.inner(sigma(u0), small_strain(u0)) / 2 + density * ufl.inner(v0, v0) / 2
    energy = fem.form(energy * dx)
    of_body = ufl.Measure("dx", domain=mesh, subdomain_data=bodies.cell_tags)
    momenta = [fem.form(density * v0[0] * of_body(body)) for body in (1, 2)]
    pressures, energies = [], []
    for _ in range(steps):
        u1 = problem.solve().x.array
        a1 = acceleration(u1, u0.x.array, v0.x.array, a0.x.array)
        v0.x.array[:] += dt * ((1 - gamma) * a0.x.array + gamma * a1)
        u0.x.array[:], a0.x.array[:] = u1, a1
        problem.advance()
        pressures.append(problem.report.contacts[0].normal_force / h)
        energies.append(comm.allreduce(fem.assemble_scalar(energy)))
    velocities = [comm.allreduce(fem.assemble_scalar(p)) / (rho * h * L) for p in momenta]
    return np.array(pressures), np.array(energies), velocities


steps = round(1.15 * 2 * L / c / dt)
times = dt * np.arange(1, steps + 1)
pressure, energy, velocities = impact(redistributed_density(mesh, rho, contacts), steps)
jumping, growing, _ = impact(fem.Constant(mesh, rho), steps)

# ## Comparison with the waves of one dimension

ends_at = times[pressure > 0].max()
plateau = np.median(pressure[times < ends_at])
kinetic = rho * h * L * v**2 / 2
if comm.rank == 0:
    print(f"contact until {1e6 * ends_at:.1f} us, 2 L / c = {1e6 * 2 * L / c:.1f} us")
    print(f"pressure {1e-6 * plateau:.2f} MPa, rho c v / 2 = {1e-6 * rho * c * v / 2:.2f} MPa")
    print(f"velocities {velocities[0]:.3f} and {velocities[1]:.3f} m/s, before 1 and 0")
    print(
        f"energy {energy[-1] / kinetic:.4f}, with mass at the contact {growing[-1] / kinetic:.2f}"
    )

exact = np.where(times < 2 * L / c, 0.5 * rho * c * v, 0.0)
draw_profile(
    Path("results") / "impact_of_bars.png",
    {
        "mass at the contact": (1e6 * times, 1e-6 * jumping, "x"),
        "no mass at the contact": (1e6 * times, 1e-6 * pressure, "o"),
        "waves": (1e6 * times, 1e-6 * exact, "-"),
    },
    xlabel="time [µs]",
    ylabel="contact pressure [MPa]",
    title="Impact of two equal bars",
)
draw_profile(
    Path("results") / "impact_of_bars_energy.png",
    {
        "mass at the contact": (1e6 * times, growing / kinetic, "-"),
        "no mass at the contact": (1e6 * times, energy / kinetic, "-"),
    },
    xlabel="time [µs]",
    ylabel="energy / energy before",
    title="Energy of the bars",
)
