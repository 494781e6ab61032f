r"""A hub shrunk onto a hollow shaft: two rings whose meshes do not match.

# Shrink fit

The bore of an aluminium hub has a radius smaller by d = 0.02 mm than that of the hollow steel shaft
onto which the hub is shrunk. By Lamé's formulas for thick rings in plane strain, with
the radii r_1 of the shaft's bore, r_2 of the fit and r_3 of the hub, the pressure of the fit is

$$p = \frac{d}{r_2} \left[ \frac{C_1 - \nu'_1}{E'_1} + \frac{C_2 + \nu'_2}{E'_2} \right]^{-1}, \quad
C_1 = \frac{r_2^2 + r_1^2}{r_2^2 - r_1^2}, \quad C_2 = \frac{r_3^2 + r_2^2}{r_3^2 - r_2^2},$$

where $E' = E / (1 - \nu^2)$ and $\nu' = \nu / (1 - \nu)$, index 1 for the
shaft and 2 for the hub.

The rings are meshed apart: their surfaces are polygons with other numbers of sides, whose distance
varies by as much as the interference. Both are therefore drawn with the same radius, and the
interference is given as a number.

This demo illustrates how to

- define contact between meshes that do not match: there is nothing to say but the two tags;
- prescribe an interference by `initial_gap`;
- see in the report how the surfaces were paired.

Run it by `python demos/shrink_fit.py`, or on several processes by
`mpirun -n 2 python demos/shrink_fit.py`; it draws a picture into `results/`. The mesh comes
from `meshes/shrink_fit.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_deformed, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Mesh
#
# A quarter of both rings; x = 0 and y = 0 are planes of symmetry.

rings = read_msh(here.parent / "meshes" / "shrink_fit.msh", MPI.COMM_WORLD, gdim=2)
mesh, facet_tags, tags = rings.mesh, rings.facet_tags, rings.names
bore, radius, outside = 0.02, 0.04, 0.07

# ## Linear elasticity, plane strain
#
# One form with one integral for each body.

interference = 2e-5
materials = {"shaft": (2.1e11, 0.3), "hub": (7e10, 0.33)}


def plane_strain(u):
    """Return the small strain, 3 x 3, zero along the axis."""
    e = ufl.sym(ufl.grad(u))
    return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, 0]])


sigma = {body: isotropic(E, nu, plane_strain) for body, (E, nu) in materials.items()}
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=mesh, subdomain_data=rings.cell_tags)
a_form = sum(ufl.inner(sigma[body](u), plane_strain(v)) * dx(tags[body]) for body in materials)

# ## Supports

sides = ("symmetry_x", 0), ("symmetry_y", 1)
bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in sides]

# ## Contact
#
# There is no load. The hub, softer and with larger elements, is the slave. A negative gap is an
# interference.

fit = ContactPair(
    facet_tags,
    slave=tags["hub inside"],
    master=tags["shaft outside"],
    name="fit",
    initial_gap=-interference,
)
problem = ContactProblem(a_form, 0, bcs=bcs, contacts=[fit])
uh = problem.solve()

# ## Comparison with Lamé

flexibility = 0.0
for sign, body, inner, outer in ((-1, "shaft", bore, radius), (1, "hub", radius, outside)):
    E, nu = materials[body]
    C = (outer**2 + inner**2) / (outer**2 - inner**2)
    flexibility += (C + sign * nu / (1 - nu)) * (1 - nu**2) / E
lame = interference / radius / flexibility

nodes = problem.results[0].gather()
pressure = nodes.nodal_normal_force.sum() / nodes.area.sum()
spread = np.abs(nodes.pressure / lame - 1).max()
if mesh.comm.rank == 0:
    print(problem.report.matching_table())
    print(f"mean pressure {1e-6 * pressure:.3f} MPa, Lamé {1e-6 * lame:.3f}", end="  ")
    print(f"{pressure / lame - 1:+.2%}, at the nodes within {spread:.2%}")

# ## Pictures

x = ufl.SpatialCoordinate(mesh)
is_hub = ufl.conditional(ufl.gt(ufl.inner(x, x), radius**2), 1.0, 0.0)
stress = von_mises(mesh, is_hub * sigma["hub"](uh) + (1 - is_hub) * sigma["shaft"](uh))
draw_deformed(
    results / "shrink_fit.png",
    uh,
    stress,
    label="von Mises stress",
    unit="MPa",
    scale=1,
    title="Aluminium hub shrunk onto a steel shaft",
)
