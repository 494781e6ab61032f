r"""A thin ring is crushed between plates to less than half its height, against the elastica.

# Crushed ring

A ring of radius R and thickness t is pressed between two plates, without friction. At first each
plate touches it at one point. When the ring is flattened to 0.72 of its height, its curvature
vanishes there. From then on its middle lies flat against the plate, without pressure, and two
points carry the force.

A thin rod that does not stretch has a formula for this, Euler's elastica. Let N be half the force,
the bending stiffness be D, phi the angle of the axis to the plate and kappa its curvature at the
plate. Then a quarter of the ring has the length and height

$$\ell = \int_0^{\pi/2} \frac{\mathrm{d} \varphi}{k}, \quad
\frac{H}{2} = \int_0^{\pi/2} \frac{\sin \varphi \, \mathrm{d} \varphi}{k}, \quad
k^2 = \kappa^2 + \frac{2 N}{D} \sin \varphi,$$

where the length is that of the quarter, pi R / 2, while kappa > 0, and shorter after kappa = 0.

This demo illustrates how to

- compute rotations of a right angle in few load steps;
- let plates of which nothing is meshed move;
- compare with a theory of thin bodies.

Run it by `python demos/crushed_ring.py`, or on several processes by
`mpirun -n 2 python demos/crushed_ring.py`; it draws pictures into `results/`. A part of the
height to be closed, such as 0.2, may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import ufl
from dolfinx import fem

from fenics_tfeti import NonlinearContactProblem, Plane, RigidObstacle
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

# ## Half a ring
#
# A box that is bent, with displacements of degree 2.

E, nu = 2e8, 0.3
R, t = 50e-3, 2.5e-3
UPPER, LOWER, CUT = 1, 2, 3
mesh = boxes(comm, [Box((0, -t / 2), (np.pi, t / 2), (40, 2))], "quadrilateral").mesh
markers = {
    UPPER: lambda x: np.isclose(x[1], t / 2) & (x[0] < np.pi / 2 + 1e-6),
    LOWER: lambda x: np.isclose(x[1], t / 2) & (x[0] > np.pi / 2 - 1e-6),
    CUT: lambda x: np.isclose(x[0], 0) | np.isclose(x[0], np.pi),
}
facet_tags = tag_facets(mesh, markers)
angle, radius = mesh.geometry.x[:, 0].copy(), R + mesh.geometry.x[:, 1]
mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = radius * np.sin(angle), radius * np.cos(angle)

# ## Problem
#
# The plates are rigid. They are functions of where they are now.

V = displacement_space(mesh, 2)
u = fem.Function(V)
energy = neo_hookean(E, nu)(u) * ufl.dx(metadata={"quadrature_degree": 4})
closed = {"now": 0.0}


def above(x):
    """Return the gap below the upper plate, and its normal."""
    return Plane((0, R + t / 2 - closed["now"] / 2), (0, -1))(x)


def below(x):
    """Return the gap above the lower plate, and its normal."""
    return Plane((0, -R - t / 2 + closed["now"] / 2), (0, 1))(x)


problem = NonlinearContactProblem(
    ufl.derivative(energy, u, ufl.TestFunction(V)),
    u,
    bcs=[symmetry_plane(V, facet_tags, CUT, 0)],
    contacts=[RigidObstacle(facet_tags, UPPER, above), RigidObstacle(facet_tags, LOWER, below)],
)

# ## Elastica
#
# The integrals depend on c = kappa^2 D / (2 N) only.

D = E / (1 - nu**2) * t**3 / 12


def quarter(c):
    """Return the length and the height of a quarter of the ring, times the root of 2 N / D."""
    length = quad(lambda p: 1 / np.sqrt(c + np.sin(p)), 0, np.pi / 2)[0]
    height = quad(lambda p: np.sin(p) / np.sqrt(c + np.sin(p)), 0, np.pi / 2)[0]
    return length, height


def height_of(c):
    """Return the height of the axis of the ring before its middle is flat."""
    length, half = quarter(c)
    return np.pi * R * half / length


def elastica(height):
    """Return the force of the whole ring at a height of its axis."""
    c = brentq(lambda c: height_of(c) - height, 0, 1e6) if height > height_of(0) else 0
    return D * (2 * quarter(c)[1] / height) ** 2


# ## Load steps
#
# Forces of half a ring are doubled.

(closing,) = (2 * R * float(part) for part in sys.argv[1:] or [0.6])
heights, forces, exact, newton = [], [], [], []
for step in problem.steps(lambda s: closed.update(now=s), 0.0, closing, first=0.1 * R):
    heights.append(2 * R - step)
    forces.append(-2 * problem.results[0].force[1])
    exact.append(elastica(heights[-1]))
    newton += problem.report.newton

error = np.abs(np.array(forces) / exact - 1).max()
if comm.rank == 0:
    products = np.mean([step.products for step in newton])
    print(
        f"{len(newton)} Newton steps in {len(forces)} load steps, {products:.0f} products in each"
    )
    print(f"force at {heights[-1] / (2 * R):.0%} of the height {forces[-1]:.1f} N/m")
    print(f"elastica {exact[-1]:.1f} N/m, largest difference {error:.2%}")

# ## Pictures

draw_deformed(
    results / "crushed_ring.png",
    u,
    von_mises(mesh, neo_hookean_stress(E, nu)(u)),
    label="von Mises stress",
    unit="MPa",
    title="Half a ring between plates",
    scale=1,
)
fine = np.linspace(0.8 * R, 1.99 * R, 60)
draw_profile(
    results / "crushed_ring_force.png",
    {
        "elastica": (1 - fine / (2 * R), [elastica(height) for height in fine], "-"),
        "finite strains": (1 - np.array(heights) / (2 * R), forces, "o"),
    },
    xlabel="closed part of the height",
    ylabel="force [N/m]",
    title="A ring crushed between plates",
)
