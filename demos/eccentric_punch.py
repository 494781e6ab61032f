r"""A rigid punch under an eccentric force: it tilts, and lifts off beyond half of its radius.

# Eccentric punch

A long rigid punch of the width 2a stands on an elastic half space, in plane strain. The force F
per unit of length acts at the distance e from its middle. Up to e = a/2 all of the punch touches,
with pressure and tilt

$$p(x) = \frac{F}{\pi \sqrt{a^2 - x^2}} \left( 1 + \frac{2 e x}{a^2} \right), \quad
\theta = \frac{4 F e}{\pi E^* a^2}, \quad E^* = \frac{E}{1 - \nu^2}.$$

Beyond, the punch lifts off on one side. What touches is as a punch of half the width b = 2 (a - e)
with the force at b/2 from its middle: the pressure falls to zero where contact ends.

This demo illustrates how to

- make an obstacle a `RigidBody`, which a force and a moment move;
- leave components of its motion free, and prescribe others;
- change the load between solves by constants of dolfinx.

Run it by `python demos/eccentric_punch.py`, or on several processes by
`mpirun -n 2 python demos/eccentric_punch.py`; it draws a picture into `results/`. All units are SI,
forces are per metre of depth.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, RigidBody, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, draw_profile, tag_facets
from fenics_tfeti.models import isotropic

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# A hard plastic. The body ends at 50 a, where it is held.

a, F, E, nu = 0.01, 1e5, 2e9, 0.3
E_star = E / (1 - nu**2)

# ## Mesh
#
# A square of equal cells, whose nodes are moved so that half of them are near the punch, and one at
# each of its edges.

n, far = 80, 50 * a
body = boxes(comm, [Box((-1, -1), (1, 0), (2 * n, n))], "quadrilateral")
mesh = body.mesh
TOP, FAR = 1, 2
marks = [
    (TOP, lambda x: np.isclose(x[1], 0)),
    (FAR, lambda x: np.abs(x[:2]).max(axis=0) > 1 - 1e-9),
]
facet_tags = tag_facets(mesh, marks)
near = np.linalg.solve([[0.4, 0.4**9], [1, 1]], [a, far])
mesh.geometry.x[:] = near[0] * mesh.geometry.x + near[1] * mesh.geometry.x**9

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
form = ufl.inner(isotropic(E, nu)(u), ufl.grad(v)) * ufl.dx
bcs = [fem.dirichletbc(np.zeros(2), fem.locate_dofs_topological(V, 1, facet_tags.find(FAR)), V)]

# ## The punch
#
# It moves downwards and turns, and does not slide. Beside it there is no obstacle.

moment = fem.Constant(mesh, 0.0)
punch = RigidBody(
    reference=(0.0, 0.0),
    force=(0.0, -F),
    moment=moment,
    translation=(0.0, None),
    name="punch",
)


def flat_end(x):
    """Return the gap to the punch and its normal."""
    gap = np.where(np.abs(x[0]) < a * (1 + 1e-6), 0.0, np.inf)
    return gap, np.tile([[0.0], [-1.0]], gap.size)


contact = RigidObstacle(facet_tags, slave=TOP, obstacle=flat_end, rigid_body=punch)
options = {"preconditioner": "lumped"}
problem = ContactProblem(form, 0, bcs=bcs, contacts=[contact], options=options)

# ## Three positions of the force
#
# The tilt is compared with the formula, whose b is a while all of the punch touches.

curves, errors = {}, []
mean = F / (2 * a)
for share, style in ((0.0, "s"), (0.4, "o"), (0.75, "^")):
    e = share * a
    moment.value = -F * e
    problem.solve()
    motion = problem.rigid_bodies["punch"]
    b = min(a, 2 * (a - e))
    middle, off = a - b, e - (a - b)
    tilt = -4 * F * off / (np.pi * E_star * b**2)
    touching = problem.results[0].gather()
    x, p = touching.coordinates[:, 0], touching.pressure / mean
    inside = np.linspace(-0.99, 0.99, 400)
    formula = 2 * a / (np.pi * b) * (1 + 2 * off / b * inside) / np.sqrt(1 - inside**2)
    order = np.argsort(x)
    shown = order[np.abs(x[order]) < 0.97 * a]
    curves[f"e = {share:g} a"] = (x[shown] / a, p[shown], style)
    curves[f"formula, {share:g} a"] = ((middle + b * inside) / a, formula, "-")
    errors.append(motion.rotation[0] / tilt - 1 if e else motion.rotation[0])
    if comm.rank == 0:
        width = np.ptp(x[touching.active]) / a
        compared = f", formula {1e3 * tilt:.3f} mrad" if e else ""
        turned = round(1e3 * motion.rotation[0], 3) + 0.0
        print(f"e = {share:g} a: {width:.2f} a touch, tilts by {turned:.3f} mrad{compared}")

# ## Picture

draw_profile(
    results / "eccentric_punch.png",
    curves,
    xlabel="distance from the middle / a",
    ylabel="pressure / mean pressure",
    title="Pressure under an eccentric force",
)
