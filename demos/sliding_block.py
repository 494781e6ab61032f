"""A block pushed over a bump: large sliding without penetration.

# Sliding block

An elastic block with a round foot is pushed, step by step, over the bump of another elastic body,
in two dimensions (plane strain) and without friction. The horizontal displacement s of the upper
part of the block is prescribed, so that the block does not rotate; its vertical displacement is
free. A traction presses it down. The result is the horizontal force H(s) that the motion needs.

Linearised contact conditions are those of the undeformed surfaces: each node of the foot slides on
a straight line, whether there is a bump or not. With `gaps=Deformed()` the
solver measures normals and gaps on the deformed surfaces, pairs the nodes anew, and solves again,
until no node penetrates and each contact force acts at a closed gap.

The bump is symmetric, so H is antisymmetric about its top. Without friction no energy is lost: the
work of H over the whole bump is zero. For rigid bodies H would be the load times the slope of the
path of the block; elastic bodies differ little, since the contact area is narrow.

This demo illustrates how to

- ask for exact non-penetration, and read from the report what each geometry pass leaves;
- move a body in steps, by a prescribed displacement that is a `Constant`;
- compute resultants of nodal contact forces.

Run it by `python demos/sliding_block.py`, or on several processes by
`mpirun -n 2 python demos/sliding_block.py`; it draws pictures into `results/`. The mesh comes from
`meshes/sliding_block.py`. The first step and the one after the last, such
as 5 12, may be given. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import Along, ContactPair, ContactProblem, Deformed
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# Hard rubber, pressed by 50 kPa on 0.6 m. The block starts 1.2 m left of the top of the bump, which
# is a cosine, 1.2 m wide and 80 mm high. The foot is an arc of radius 0.5 m.

E, nu = 1e7, 0.3
pressure, width = 5e4, 0.6
start, height, half_width, radius = -1.2, 0.08, 0.6, 0.5
first, end = map(int, sys.argv[1:] or (0, 23))
steps = np.linspace(0, -2 * start, 23)[first:end]

bodies = read_msh(here.parent / "meshes" / "sliding_block.msh", comm, gdim=2)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names
sigma = isotropic(E, nu)
load = fem.Constant(mesh, -pressure)
shift, zero = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)


V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L = load * v[1] * ds(tags["top"])

# The base is fixed at its bottom. The horizontal displacement is prescribed on the top of the block
# and on the upper part of its sides.

bcs = []
prescribed = ("ground", 0, zero), ("ground", 1, zero), ("top", 0, shift), ("guide", 0, shift)
for name, component, value in prescribed:
    Vi = V.sub(component)
    dofs = fem.locate_dofs_topological(Vi, 1, facet_tags.find(tags[name]))
    bcs.append(fem.dirichletbc(value, dofs, Vi))

# The foot is the slave. Its nodes start above nodes of the base, and are paired vertically.

contact = ContactPair(
    facet_tags, slave=tags["block surface"], master=tags["base surface"], partners=Along((0, 1))
)
exact = Deformed(tolerance=1e-5, max_passes=40)
problem = ContactProblem(a, L, bcs=bcs, contacts=[contact], gaps=exact)

# For comparison, a problem whose only geometry pass gives the linearised solution.

once = {"gaps": Deformed(max_passes=1), "options": {"error_if_not_converged": False}}


def tell(line):
    """Print on one rank."""
    if comm.rank == 0:
        print(line, flush=True)


# ## Steps
#
# Each solve starts from the contact forces, normals and pairs of the step before. The contact force
# on the block is -force * normal at each of its nodes; H balances its horizontal part.

drawn = {0: "start", 7: "up", 11: "top", 15: "down"}
H, F = [], []


def error(geometry_pass):
    """Return the largest penetration of a node, or gap at a node with a contact force [mm]."""
    return 1e3 * max(geometry_pass.penetration, geometry_pass.separation)


for step, s in enumerate(steps, start=first):
    shift.value = s
    uh = problem.solve()
    nodes = problem.results[0].gather()
    push = nodes.nodal_normal_force @ nodes.normal
    H.append(push[0])
    F.append(-push[1])

    passes = problem.report.passes
    tell(
        f"at {s + start:+.3f} m: H = {H[-1]:7.1f} N/m, {len(passes)} passes; penetration or gap "
        f"{error(passes[-1]):.4f} mm"
    )
    if step in drawn:
        linearised = ContactProblem(a, L, bcs=bcs, contacts=[contact], **once)
        linearised.solve()
        tell(f"  linearised {error(linearised.report.passes[0]):.1f} mm")
        draw_deformed(
            results / f"sliding_block_{drawn[step]}.png",
            uh,
            von_mises(mesh, sigma(uh), poisson_ratio=nu),
            label="von Mises stress",
            unit="kPa",
            title=f"A block pushed over a bump, at x = {round(s + start, 1) + 0.0:.1f} m",
            scale=1,
        )

# ## The force against the position
#
# A rigid block rises by the largest height of the bump above its foot.

position, H = steps + start, np.array(H)
fine = np.linspace(start, -start, 2001)
offset = np.linspace(-0.5 * width, 0.5 * width, 2001)
foot = radius - np.sqrt(radius**2 - offset**2)
x = fine[:, None] + offset
bump = np.where(np.abs(x) < half_width, 0.5 * height * (1 + np.cos(np.pi * x / half_width)), 0)
rise = np.max(bump - foot, axis=1)
rigid = pressure * width * np.gradient(rise, fine)

top = np.abs(position).argmin()
rigid_work = pressure * width * height
parts = 0.5 * (H[1:] + H[:-1]) * np.diff(position)
tell(f"largest force {np.abs(H).max():.1f} N/m, of rigid bodies {np.abs(rigid).max():.1f} N/m")
tell(f"work up to the top {parts[:top].sum():.1f} J/m, of rigid bodies {rigid_work:.1f} J/m")
if len(steps) == 23:
    asymmetry = np.abs(H + H[::-1]).max()
    tell(
        f"work over the whole bump {parts.sum():.1f} J/m; largest H(-x) + H(x) {asymmetry:.1f} N/m"
    )

draw_profile(
    results / "sliding_block_force.png",
    {
        "rigid bodies": (fine, 1e-3 * rigid, "--"),
        "elastic bodies": (position, 1e-3 * H, "o"),
    },
    xlabel="position of the block against the top of the bump [m]",
    ylabel="horizontal force [kN/m]",
    title="Force that pushes a block over a bump without friction",
)
