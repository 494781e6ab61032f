r"""A heavy plank, lifted at one end: Total FETI for matrices that SciPy assembles, without dolfinx.

# A plank on the floor

A steel plank, 4 m long and 0.1 m high, lies on a rigid floor. Its left end is lifted by delta =
1 mm. A part of length s leaves the floor; the rest lies flat. With the weight q per length and the
bending stiffness EI, beam theory gives

$$s = (24 E I \delta / q)^{1/4}, \quad V = q s / 2,$$

V being the force that lifts the end.

This demo illustrates how to

- give `fenics_tfeti.feti` the stiffness matrices, loads and node numbers of any program;
- glue subdomains: by equal node numbers, and nothing else;
- share one matrix between equal subdomains, which then share its factor as well;
- write contact with a rigid body as rows, and read forces and reactions from the result;
- write the system to a file for `python -m fenics_tfeti.feti`.

Run it by `python demos/plank.py`; it writes the system, the report and a picture into `results/`.
Of the Python packages only NumPy, SciPy, petsc4py, mpi4py and Matplotlib are used. All units are
SI.
"""

from pathlib import Path

import matplotlib
import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti import (
    ContactRows,
    Options,
    Prescribed,
    Subdomain,
    TornSolver,
    TornSystem,
    save_system,
)

matplotlib.use("Agg")
from matplotlib import pyplot

results = Path("results")
results.mkdir(exist_ok=True)

# ## Data
#
# Plane stress, for a plank of width 1 m: all forces are those of 1 m.

E, nu, weight = 2e11, 0.3, 7.7e4
length, height, delta = 4.0, 0.1, 1e-3
q, EI = weight * height, E * height**3 / 12
s = (24 * EI * delta / q) ** 0.25
V = q * s / 2

# ## The matrix of one subdomain
#
# The plank is cut into squares. On a square of n x n bilinear elements the stiffness matrix is made
# of the matrices of n linear elements on a line: with the functions phi_i of the nodes,
# M_ij = int phi_i phi_j, D_ij = int phi_i' phi_j' and C_ij = int phi_i' phi_j. The displacements of
# a node follow each other, as `Subdomain` wants them.

n = 10
h = height / n
M = h / 6 * sp.diags([np.r_[2, np.full(n - 1, 4), 2], np.ones(n), np.ones(n)], [0, 1, -1])
D = 1 / h * sp.diags([np.r_[1, np.full(n - 1, 2), 1], -np.ones(n), -np.ones(n)], [0, 1, -1])
C = 0.5 * sp.diags([np.r_[-1, np.zeros(n - 1), 1], -np.ones(n), np.ones(n)], [0, 1, -1])
lmbda, mu = E * nu / (1 - nu**2), E / (2 * (1 + nu))
K_xx = (lmbda + 2 * mu) * sp.kron(D, M) + mu * sp.kron(M, D)
K_yy = (lmbda + 2 * mu) * sp.kron(M, D) + mu * sp.kron(D, M)
K_xy = lmbda * sp.kron(C, C.T) + mu * sp.kron(C.T, C)

size = (n + 1) ** 2
interleaved = np.arange(2 * size).reshape(2, size).T.ravel()
K = sp.csr_matrix(sp.bmat([[K_xx, K_xy], [K_xy.T, K_yy]]).tocsr()[interleaved][:, interleaved])

node_areas = np.asarray(sp.kron(M, M).sum(axis=1)).ravel()
f = np.column_stack([np.zeros(size), -weight * node_areas]).ravel()

# ## The torn plank
#
# Node i, j of the whole grid has the number (n + 1) i + j. A square has the nodes of its part of
# the grid, so that two neighbours share the numbers of a column of nodes: there they are glued. All
# squares have the same matrix, the same object `K`: it is factorised once.

squares = round(length / height)
i, j = (index.ravel() for index in np.meshgrid(range(n + 1), range(n + 1), indexing="ij"))
plank = []
for square in range(squares):
    column = square * n + i
    coordinates = h * np.column_stack([column, j])
    plank.append(Subdomain(K, f, coordinates, nodes=(n + 1) * column + j, body=0))

# ## Support and contact
#
# The lower corner on the left is lifted. The other nodes of the lower face must not go below the
# floor: the normal of the plank points downwards, there is no other body (-1), and no gap.

lifted = Prescribed(nodes=[0, 0], components=[0, 1], values=[0.0, delta])

columns = np.arange(1, squares * n + 1)
lower_face = (n + 1) * columns
floor = ContactRows.node_to_node(
    slave=lower_face,
    master=np.full(columns.size, -1),
    normal=np.tile([0.0, -1.0], (columns.size, 1)),
    gap=np.zeros(columns.size),
    contact=np.zeros(columns.size, dtype=int),
)

# ## The solution
#
# The report has the forces; its certificate bounds the error.

system = TornSystem(plank, lifted, floor, 2, ["plank"], ["floor"], condition_names=["crane"])
solution = TornSolver(system, Options(rtol=1e-8)).solve()
report = solution.report
report.to_json(results / "plank.json")

lifting_force = report.reactions[0].force[1]
floor_force = report.contacts[0].normal_force
first_contact = h * columns[solution.active].min()
print(f"lifting force {lifting_force:.0f} N, by beam theory {V:.0f} N")
print(f"lifted length {first_contact:.2f} m, by beam theory {s:.2f} m")
print(f"weight {q * length:.0f} N, lifted and carried {lifting_force + floor_force:.0f} N")
print(f"{report.products['total']} iterations, error {report.certificate.error:.1e}")

# The displacements come by subdomain, in the order of its nodes.

x = h * np.arange(squares * n + 1)
deflection = np.zeros(x.size)
for square, displacement in zip(plank, solution.displacements, strict=True):
    lower = square.coordinates[:, 1] == 0.0
    at = np.rint(square.coordinates[lower, 0] / h).astype(int)
    deflection[at] = displacement[1::2][lower]

# w'''' = -q / EI from the point of lift-off on, where deflection, slope and moment vanish
t = np.maximum(s - x, 0.0)
beam = q / EI * (s * t**3 / 12 - t**4 / 24)

figure, axes = pyplot.subplots(figsize=(8, 3), layout="constrained")
axes.plot(x, 1e3 * deflection, label="plane stress")
axes.plot(x, 1e3 * beam, "k--", label="beam theory")
axes.plot(x, 0 * x, "k", linewidth=3)
axes.set(xlabel="x [m]", ylabel="height of the lower face [mm]")
axes.legend()
figure.savefig(results / "plank.png", dpi=120)

# ## The same from a file
#
# `python -m fenics_tfeti.feti results/plank.npz --rtol 1e-8` solves the system again, on any
# number of processes.

save_system(results / "plank.npz", system)
