r"""Two half planes pressed and pushed on each other: the stick zone of Cattaneo and Mindlin.

# Partial slip

A cylinder of radius R = 40 mm lies on a plane of the same material. It is pressed by a force P' per
length, then pushed sideways by Q'. Where it touches, |x| < a, the pressure is Hertz's; friction
allows a traction of mu p. Before the cylinder slides as a whole it slips at the edges of the
contact only. In the middle, |x| < c, it sticks (Cattaneo 1938, Mindlin 1949):

$$c / a = \sqrt{1 - Q' / (\mu P')},$$
$$q(x) = \mu p_0 \left[ \sqrt{1 - x^2 / a^2} - \frac{c}{a} \sqrt{1 - x^2 / c^2} \, \right].$$

This demo illustrates how to

- give a contact Coulomb's law of friction;
- apply loads one after the other: each solve counts slip from the end of the last one;
- prescribe the gap of curved surfaces on flat meshes;
- find out what sticks and what slips.

Run it by `python demos/cattaneo_mindlin.py`; it draws a picture into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Coulomb
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic

results = Path("results")

# ## Mesh
#
# Two blocks, 16 mm wide and 8 mm high, on each other. The grid grows away from the contact, whose
# half-width is about 1.4 mm.

width, n = 8e-3, 44
parts = [Box((-1, 0), (1, 1), (n, n // 2), "upper"), Box((-1, -1), (1, 0), (n, n // 2), "lower")]
blocks = boxes(MPI.COMM_WORLD, parts, "quadrilateral")
mesh = blocks.mesh
mesh.geometry.x[:, :2] = width * np.sinh(3 * mesh.geometry.x[:, :2]) / np.sinh(3)

TOP, BOTTOM, SLAVE, MASTER = 1, 2, 3, 4


def near(x):
    """Select the middle of the surfaces."""
    return np.isclose(x[1], 0) & (np.abs(x[0]) < 3e-3)


facet_tags = tag_facets(
    mesh,
    [
        (TOP, lambda x: np.isclose(x[1], width)),
        (BOTTOM, lambda x: np.isclose(x[1], -width)),
        (SLAVE, near, 1),
        (MASTER, near, 2),
    ],
    blocks.cell_tags,
)

# ## Linear elasticity, plane strain

E, nu, R, friction = 2e9, 0.3, 0.04, 0.3
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a_form = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx

# The top is moved as a whole.

move = fem.Constant(mesh, np.zeros(2))
top, bottom = (fem.locate_dofs_topological(V, 1, facet_tags.find(tag)) for tag in (TOP, BOTTOM))
bcs = [fem.dirichletbc(move, top, V), fem.dirichletbc(np.zeros(2), bottom, V)]

# ## Contact with friction
#
# The gap between the flat surfaces is that of the cylinder and the plane.

pair = ContactPair(
    facet_tags, SLAVE, MASTER, initial_gap=lambda x: x[0] ** 2 / (2 * R), friction=Coulomb(friction)
)
options = {"subdomain_size": 400}
problem = ContactProblem(
    a_form, 0, bcs=bcs, contacts=[pair], cell_tags=blocks.cell_tags, options=options
)

# ## Pressed, then pushed in three steps
#
# Half-width and largest pressure are found by a straight line through p^2 over x^2.

curves, sticking = {}, []
for push, style in ((0.0, ""), (8e-6, "o"), (16e-6, "s"), (24e-6, "^")):
    move.value[:] = push, -60e-6
    problem.solve()
    problem.advance()
    contact = problem.results[0].gather()
    x, p, q = contact.coordinates[:, 0], contact.pressure, -contact.friction.traction[:, 0]
    inner = p > 0.3 * p.max()
    slope, constant = np.polyfit(x[inner] ** 2, p[inner] ** 2, 1)
    a, p0 = np.sqrt(-constant / slope), np.sqrt(constant)
    P, Q = contact.nodal_normal_force.sum(), -contact.friction.force[:, 0].sum()
    c = a * np.sqrt(1 - Q / (friction * P))
    stick = np.abs(x[contact.friction.sticking]).max()
    size = contact.area[np.abs(x) < a].max()
    if mesh.comm.rank == 0:
        print(
            f"Q / (mu P) = {Q / (friction * P):5.3f}: sticks up to {1e3 * stick:.3f} mm, "
            f"c = {1e3 * c:.3f} mm, elements of {1e3 * size:.3f} mm"
        )
    if push:
        line = np.linspace(-a, a, 601)
        exact = np.sqrt(np.maximum(1 - (line / a) ** 2, 0))
        exact -= c / a * np.sqrt(np.maximum(1 - (line / c) ** 2, 0))
        share = f"Q = {Q / (friction * P):.2f} mu P"
        curves[share] = (1e3 * x, 1e-6 * q, style)
        curves[f"exact, {share}"] = (1e3 * line, 1e-6 * friction * p0 * exact, "-")
        sticking.append((stick, c, size))

# ## Picture

curves["mu p"] = (1e3 * x, 1e-6 * friction * p, ":")
draw_profile(
    results / "cattaneo_mindlin_traction.png",
    curves,
    xlabel="distance from the middle [mm]",
    ylabel="tangential traction [MPa]",
    title="Partial slip: traction in the contact",
)
