r"""A belt on a drum: friction holds a large force by a small one.

# Belt on a drum

A belt lies on half of a rigid drum. One end is held, the other one is pulled by a force T. Friction
reduces the force in the belt along the drum (Euler, Eytelwein): where it slips everywhere, the held
end has

$$T_0 = T e^{-\mu \varphi}, \quad \varphi = \pi.$$

This demo illustrates how to

- use friction at a rigid obstacle, here a `Sphere`, which is a disc in two dimensions;
- bend a structured mesh by moving its nodes;
- read reactions from the report, and friction forces along a surface.

Run it by `python demos/belt_on_drum.py`; it draws pictures into `results/`.
All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, Coulomb, RigidObstacle, Sphere
from fenics_tfeti.io import (
    Box,
    boxes,
    displacement_space,
    draw_deformed,
    draw_profile,
    tag_facets,
    von_mises,
)
from fenics_tfeti.models import isotropic

results = Path("results")

# ## Mesh
#
# A strip of one element in the thickness, 2 mm, bent around a drum of radius 200 mm.

radius, thickness, n = 0.2, 2e-3, 80
belt = boxes(MPI.COMM_WORLD, [Box((0, 0), (np.pi, thickness), (n, 1))], "quadrilateral")
mesh = belt.mesh
angle, height = mesh.geometry.x[:, :2].T.copy()
mesh.geometry.x[:, 0] = (radius + height) * np.cos(angle)
mesh.geometry.x[:, 1] = (radius + height) * np.sin(angle)

DRUM, HELD, PULLED = 1, 2, 3
facet_tags = tag_facets(
    mesh,
    [
        (DRUM, lambda x: np.isclose(np.hypot(x[0], x[1]), radius)),
        (HELD, lambda x: np.isclose(x[1], 0) & (x[0] > 0)),
        (PULLED, lambda x: np.isclose(x[1], 0) & (x[0] < 0)),
    ],
)

# ## Linear elasticity
#
# A belt of polyamide, E = 2 GPa, without lateral strain; forces are per metre of its width.

E, force = 2e9, 1e4
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
pull = fem.Constant(mesh, np.array([0.0, -force / thickness]))
sigma = isotropic(E, 0.0)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = ufl.inner(pull, v) * ds(PULLED)
held = fem.locate_dofs_topological(V, 1, facet_tags.find(HELD))
bcs = [fem.dirichletbc(np.zeros(2), held, V)]

# ## Three coefficients of friction
#
# The force in the belt is the pressure times the radius.

drum = Sphere((0, 0), radius)
ratios, curves = {}, {}
for mu, style in ((0.1, "o"), (0.2, "s"), (0.3, "^")):
    contact = RigidObstacle(facet_tags, DRUM, drum, friction=Coulomb(mu), name="drum")
    problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], options={"subdomain_size": 60})
    uh = problem.solve()
    report = problem.report
    ratios[mu] = np.linalg.norm(report.reactions[0].force) / force
    contact = problem.results[0].gather()
    phi = np.arctan2(contact.coordinates[:, 1], contact.coordinates[:, 0])
    inner = (phi > 0.05) & (phi < np.pi - 0.05)
    tension = contact.pressure * radius
    curves[f"mu = {mu:g}"] = (np.degrees(phi[inner]), 1e-3 * tension[inner], style)
    order = np.argsort(phi)
    exact = force * np.exp(-mu * (np.pi - phi[order]))
    curves[f"exp(-mu phi), {mu:g}"] = (np.degrees(phi[order]), 1e-3 * exact, "-")
    if mesh.comm.rank == 0:
        print(
            f"mu = {mu:g}: T0 / T = {ratios[mu]:.4f}, exp(-mu pi) = {np.exp(-mu * np.pi):.4f}; "
            f"{report.products['total']} products, {len(report.slip_bounds)} steps"
        )

# ## Pictures

draw_profile(
    results / "belt_on_drum_force.png",
    curves,
    xlabel="angle from the held end [degrees]",
    ylabel="force in the belt [kN/m]",
    title="Belt on a drum",
)
draw_deformed(
    results / "belt_on_drum.png",
    uh,
    von_mises(mesh, sigma(uh), poisson_ratio=0.0),
    label="von Mises stress",
    unit="MPa",
    title="Belt pulled over a drum at its left end, mu = 0.3",
    obstacles=[drum],
)
