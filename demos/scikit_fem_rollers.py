r"""Two rollers pressed together, assembled by scikit-fem and solved by `fenics_tfeti.feti` alone.

# Rollers with scikit-fem

Two long rollers of radius R = 1 m touch along a line and are pressed together by the force F' per
length. By Hertz's formulas, half the width a of the contact and the largest pressure are

$$a^2 = \frac{8 F' R^* (1 - \nu^2)}{\pi E}, \quad p_0 = \frac{2 F'}{\pi a}, \quad
\frac{1}{R^*} = \frac{1}{R} + \frac{1}{R}.$$

As in Hertz's theory only the surroundings of the contact are modelled, each roller by a block: the
distance of the surfaces is x^2 / (2 R*). The blocks are symmetric about x = 0.

This demo illustrates how to

- make subdomains of a mesh of scikit-fem: restrict it, assemble, and keep the numbers of its nodes;
- write the contact of two bodies as rows of pairs of nodes with gaps;
- leave a body without support: the upper block is held by contact alone against the load.

Run it by `python demos/scikit_fem_rollers.py`; it writes a report and a picture into `results/`.
It needs scikit-fem, and no dolfinx. All units are SI.
"""

from pathlib import Path

import matplotlib
import numpy as np
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
)

matplotlib.use("Agg")
from matplotlib import pyplot

results = Path("results")
results.mkdir(exist_ok=True)

# ## Data

E, nu, R_star, a = 2e9, 0.3, 0.5, 0.1
force = np.pi * E * a**2 / (8 * R_star * (1 - nu**2))
p_0 = 2 * force / (np.pi * a)

# ## The blocks
#
# Half of each block, of 1.2 m by 1.2 m. The mesh of the lower block is the mirror image of that of
# the upper one, so that nodes of the two surfaces are opposite to each other.

size, elements = 1.2, 96
lines = np.linspace(0.0, size, elements + 1)
upper = skfem.MeshQuad.init_tensor(lines, lines)
lower = upper.mirrored((0, 1))

# ## Subdomains
#
# Each block is torn into 6 x 6 squares. `restrict` gives the mesh of some elements and the numbers
# of its nodes in the mesh of the block. The upper block's numbers follow those of the lower one:
# equal numbers are glued, and the blocks must not be.
#
# The load pushes the upper face downwards. What it is made of is up to scikit-fem: here a form on
# the facets there.

form = linear_elasticity(*lame_parameters(E, nu))
element = skfem.ElementVector(skfem.ElementQuad1())


@skfem.LinearForm
def traction(v, w):
    """Return the work of the pressure on the upper face."""
    return -force / 2 / size * v[1]


def subdomains(mesh: skfem.MeshQuad, body: int, first: int, parts: int = 6) -> list[Subdomain]:
    """Tear a block into parts x parts squares, with nodes numbered from `first` on."""
    torn = []
    column, row = (parts / size * np.abs(mesh.p[:, mesh.t].mean(axis=1))).astype(int)
    for square in range(parts**2):
        inside = np.flatnonzero(parts * row + column == square)
        part, nodes = mesh.restrict(inside, return_mapping=True)
        basis = skfem.Basis(part, element)
        load = np.zeros(basis.N)
        top = part.facets_satisfying(lambda x: np.isclose(x[1], size))
        if top.size:
            load = traction.assemble(skfem.FacetBasis(part, element, facets=top))
        # unknown 2 * node + component, as scikit-fem numbers those of vertices
        torn.append(Subdomain(form.assemble(basis).tocsr(), load, part.p.T, first + nodes, body))
    return torn


blocks = subdomains(lower, 0, 0) + subdomains(upper, 1, lower.nvertices)

# ## Supports
#
# The lower block stands on a smooth floor; neither of them moves sideways at x = 0.

floor = np.flatnonzero(np.isclose(lower.p[1], -size))
symmetry = np.flatnonzero(upper.p[0] == 0.0)
axis = np.concatenate([symmetry, lower.nvertices + symmetry])
supports = Prescribed(
    nodes=np.concatenate([floor, axis]),
    components=np.repeat([1, 0], [floor.size, axis.size]),
    values=np.zeros(floor.size + axis.size),
)

# ## Contact
#
# A node of the upper surface may touch its mirror image, which has the same number in the mesh of
# the lower block. The normal is that of the slave's surface, outwards.

surface = np.flatnonzero(upper.p[1] == 0.0)
surface = surface[np.argsort(upper.p[0, surface])]
x = upper.p[0, surface]
rows = ContactRows.node_to_node(
    slave=lower.nvertices + surface,
    master=surface,
    normal=np.tile([0.0, -1.0], (x.size, 1)),
    gap=x**2 / (2 * R_star),
    contact=np.zeros(x.size, dtype=int),
)

# ## The solution
#
# The pressure is the force of a node by the length that belongs to it.

system = TornSystem(blocks, supports, rows, 2, ["lower", "upper"], ["line of contact"])
solution = TornSolver(system, Options(rtol=1e-6)).solve()
report = solution.report
report.to_json(results / "scikit_fem_rollers.json")

weights = skfem.LinearForm(lambda v, w: v).assemble(
    skfem.FacetBasis(upper, skfem.ElementQuad1(), facets=lambda x: x[1] == 0.0)
)
pressure = solution.normal_force / weights[surface]

# p^2 is linear in x^2, and zero at x = a

inner = x < 0.9 * a
slope, p_fit2 = np.polyfit(x[inner] ** 2, pressure[inner] ** 2, 1)
a_fit, p_fit = np.sqrt(-p_fit2 / slope), np.sqrt(p_fit2)
print(f"force {2 * report.contacts[0].normal_force:.6g} N/m of {force:.6g} N/m")
print(f"half-width {1e3 * a_fit:.1f} mm, by Hertz {1e3 * a:.1f} mm")
print(f"largest pressure {1e-6 * p_fit:.1f} MPa, by Hertz {1e-6 * p_0:.1f} MPa")
print(f"{report.subdomains} subdomains, {report.products['total']} iterations")

figure, axes = pyplot.subplots(figsize=(6, 3), layout="constrained")
near = x <= 1.5 * a
axes.plot(
    1e3 * x[near], 1e-6 * pressure[near], "o", markersize=3, label="scikit-fem and Total FETI"
)
r = a * np.sin(np.linspace(0, np.pi / 2, 100))
axes.plot(1e3 * r, 1e-6 * p_0 * np.sqrt(1 - (r / a) ** 2), "k", linewidth=1, label="Hertz")
axes.set(xlabel="x [mm]", ylabel="pressure [MPa]", xlim=(0, 1.5e3 * a), ylim=(0, None))
axes.legend()
figure.savefig(results / "scikit_fem_rollers.png", dpi=120)
