r"""A cam turned by half a turn under a follower: large rotation and sliding, with its energy.

# Cam

An eccentric disc turns about a shaft, in plane strain and without friction. A follower with a flat
foot, guided at its sides, stands on it; a spring presses it down. In half a turn the follower rises
by twice the eccentricity e, and half of the cam's circumference slides along the foot. For rigid
bodies the moment that turns the cam by the angle t is

$$M = k (d + e (1 - \cos t)) \, e \sin t,$$

where k is the stiffness of the spring and d what it is shortened by at first. Elastic bodies give
way, so that M is smaller. Its work is the energy that the bodies and the spring store.

Linear elasticity has no large rotations: the mesh of the cam is turned rigidly between the steps,
and its displacement counts from there. Contact is exact on the deformed surfaces
(`gaps=Deformed()`), whose meshes do not match.

This demo illustrates how to

- turn a body by moving its mesh between load steps;
- compute a moment from contact forces in the deformed state;
- put a spring into the forms, and check the balance of energy.

Run it by `python demos/cam.py`, or on several processes by `mpirun -n 2 python demos/cam.py`; it
draws pictures into `results/`. The mesh comes from `meshes/cam.py`. An angle in degrees, such as
90, may be given instead of 180. All units are SI, forces are per metre of depth.
"""

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Deformed
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# Hard rubber. The foot is at y = 0.25 m in the undeformed state; the shaft is at the origin.

E, nu = 1e7, 0.3
radius, eccentricity, foot = 0.5, 0.15, 0.25
stiffness = 1e5  # of the spring [N/m], per metre of depth
shortened = radius - eccentricity - foot
(largest,) = map(float, sys.argv[1:] or [180])
angles = np.radians(np.linspace(0, largest, round(largest / 15) + 1))

bodies = read_msh(here.parent / "meshes" / "cam.msh", comm, gdim=2)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names
sigma = isotropic(E, nu)

# ## Forms
#
# The spring acts on the follower's top, which is 1 m wide. It is part of the bilinear form; the
# stored energy is half of that form at the solution.

V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
top = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)(tags["top"])
spring = fem.Constant(mesh, stiffness)


def a(u, v):
    """Return the bilinear form."""
    return ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx + spring * u[1] * v[1] * top


# The bore is fixed to the shaft, the sides of the follower are guided.

bcs = []
for name, axis in (("bore", 0), ("bore", 1), ("guide", 0)):
    bcs.append(symmetry_plane(V, facet_tags, tags[name], axis))

contact = ContactPair(facet_tags, slave=tags["cam"], master=tags["foot"])
gaps = Deformed(tolerance=1e-4, max_passes=40)

# ## Turning the cam
#
# In the file the cam's centre is at (0, -1). At the angle 0 it is below the shaft.

x = mesh.geometry.x
of_cam = x[:, 1] < 0
drawn = x[of_cam, :2] - [0, -1]


def turn(t):
    """Put the nodes of the cam where they are at the angle t."""
    cosine, sine = np.cos(t), np.sin(t)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    x[of_cam, :2] = (drawn + [0, -eccentricity]) @ rotation.T


def moment_of(problem, uh):
    """Return the moment about the shaft that balances the contact forces on the cam."""
    nodes = problem.results[0]
    first = V.dofmap.index_map.local_range[0]
    y = nodes.coordinates[:, :2] + uh.x.array.reshape(-1, 2)[nodes.nodes - first]
    force = -nodes.nodal_normal_force[:, None] * nodes.normal
    return -comm.allreduce(float(np.sum(y[:, 0] * force[:, 1] - y[:, 1] * force[:, 0])))


# ## Steps
#
# The problem is set up at the first angle. Moved nodes are noticed in each solve.

turn(0)
problem = ContactProblem(a(u, v), 0, bcs=bcs, contacts=[contact], gaps=gaps)
M, energy = [], []
for step, t in enumerate(angles):
    turn(t)
    uh = problem.solve()
    M.append(moment_of(problem, uh))
    energy.append(comm.allreduce(fem.assemble_scalar(fem.form(0.5 * a(uh, uh)))))
    if comm.rank == 0:
        passes = len(problem.report.passes)
        print(f"{np.degrees(t):4.0f} degrees: moment {M[-1]:7.1f} N m/m, {passes} passes")
    if step == 6:
        draw_deformed(
            results / "cam.png",
            uh,
            von_mises(mesh, sigma(uh), poisson_ratio=nu),
            label="von Mises stress",
            unit="kPa",
            title="A cam lifts its follower, after a quarter turn",
            scale=1,
        )

# ## Balance
#
# The work of the moment by the trapezoidal rule is compared with the energy, at each angle.

M, energy = np.array(M), np.array(energy)
work = np.concatenate([[0], np.cumsum(0.5 * (M[1:] + M[:-1]) * np.diff(angles))])
stored = energy - energy[0]
miss = np.abs(stored - work).max() / work[-1]


def rigid(t):
    """Return the moment for rigid bodies."""
    force = stiffness * (shortened + eccentricity * (1 - np.cos(t)))
    return force * eccentricity * np.sin(t)


if comm.rank == 0:
    print(f"work of the moment {work[-1]:.1f} J/m, energy stored {stored[-1]:.1f} J/m")
    print(f"largest difference {miss:.2%} of the work")

fine = np.linspace(0, angles[-1], 200)
draw_profile(
    results / "cam_moment.png",
    {
        "rigid bodies": (np.degrees(fine), 1e-3 * rigid(fine), "--"),
        "elastic bodies": (np.degrees(angles), 1e-3 * M, "o"),
    },
    xlabel="angle [degrees]",
    ylabel="moment [kN m/m]",
    title="Moment that turns a cam under a follower with a spring",
)
