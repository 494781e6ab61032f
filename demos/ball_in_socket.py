r"""A ball in a socket of nearly the same radius, pressed by a growing force.

# Ball in a socket

A ball of radius R1 = 50 mm rests in a socket of radius R2 = 51 mm, both of a hard plastic. The
displacement is axisymmetric, as in `demos/axisymmetric_ball.py`, and the mesh that of a meridian.

Under a small force, Hertz's formulas hold with the difference of the curvatures,

$$a^3 = \frac{3 F R}{4 E^*}, \quad p(r) = p_0 \sqrt{1 - r^2 / a^2}, \quad
p_0 = \frac{3 F}{2 \pi a^2},$$

$$\frac{1}{R} = \frac{1}{R_1} - \frac{1}{R_2}, \quad E^* = \frac{E}{2 (1 - \nu^2)}.$$

Under a large force, the contact area is no longer flat nor small: it stays smaller than by the
formulas, and the pressure becomes larger. There, a finer mesh is the reference. The meshes do not
match, and the gap is as small as the distances of their facets from the spheres. Therefore it is
prescribed, as the distance between the spheres.

This demo illustrates how to

- prescribe the initial gap by a function of the place;
- solve the same problem for several loads.

Run it by `python demos/ball_in_socket.py`, or on several processes by
`mpirun -n 2 python demos/ball_in_socket.py`; it writes pictures into `results/`. The mesh comes
from `meshes/ball_in_socket.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_deformed, draw_profile, read_msh, von_mises
from fenics_tfeti.models import axisymmetric_strain, isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# The forces for which Hertz's formula gives radii of 5 mm to 40 mm.

R1, R2, E, nu = 0.05, 0.051, 2e9, 0.3
R = 1 / (1 / R1 - 1 / R2)
E_star = E / (2 * (1 - nu**2))
forces = 4 / 3 * E_star * np.array([5e-3, 10e-3, 15e-3, 20e-3, 30e-3, 40e-3]) ** 3 / R

meridian = read_msh(here.parent / "meshes" / "ball_in_socket.msh", comm, gdim=2)
mesh, facet_tags, tags = meridian.mesh, meridian.facet_tags, meridian.names

# ## The axisymmetric forms

r = ufl.SpatialCoordinate(mesh)[0]
weight = 2 * ufl.pi * r
sigma = isotropic(E, nu, axisymmetric_strain)
traction = fem.Constant(mesh, 0.0)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
a_form = ufl.inner(sigma(u), axisymmetric_strain(v)) * weight * ufl.dx
L_form = traction * v[1] * weight * ds(tags["ball top"])

# ## Supports
#
# The radial displacement on the axis is zero, and so is the vertical one at the bottom. Contact
# alone supports the ball in the vertical direction.

sides = ("ball axis", 0), ("socket axis", 0), ("socket bottom", 1)
bcs = [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in sides]

# ## Contact
#
# The socket, with the larger elements, is the slave. The ball touches it at the origin: its centre
# is at the height R1.


def gap(x):
    """Return the distance of points of the socket from the ball."""
    return np.hypot(x[0], x[1] - R1) - R1


contact = ContactPair(
    facet_tags,
    slave=tags["socket surface"],
    master=tags["ball surface"],
    initial_gap=gap,
)
problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[contact], measure_weight=weight)

# ## Load steps
#
# The mean square of r, weighted by Hertz's pressure, is 2/5 a^2: this gives the radius.

radii, peaks, hertz, curves = [], [], [], {}
# colour and marker of the loads that are drawn; Hertz's curve is a line of the same colour
for force, style in zip(forces, ("", "C0o", "", "C1s", "", "C3^"), strict=True):
    traction.value = -force / (np.pi * R1**2)
    uh = problem.solve()
    nodes = problem.results[0].gather()
    x, y = nodes.coordinates[:, :2].T
    radii.append(np.sqrt(5 / 2 * nodes.nodal_normal_force @ x**2 / nodes.nodal_normal_force.sum()))
    peaks.append(nodes.pressure.max())
    F = abs(problem.report.contacts[0].force[1])
    a = np.cbrt(3 * F * R / (4 * E_star))
    p0 = 3 * F / (2 * np.pi * a**2)
    hertz.append((a, p0))
    if comm.rank == 0:
        to_a, to_p0 = radii[-1] / a - 1, peaks[-1] / p0 - 1
        print(
            f"{1e-3 * F:5.1f} kN: radius {1e3 * radii[-1]:5.2f} mm ({to_a:+.1%} to Hertz), "
            f"pressure {1e-6 * peaks[-1]:5.2f} MPa ({to_p0:+.1%})"
        )
    if style:
        angle, line = np.degrees(np.arctan2(x, R2 - y)), np.linspace(0, a, 400)
        shown, name = angle < 55, f"{1e-3 * force:.1f} kN"
        curves[name] = angle[shown], 1e-6 * nodes.pressure[shown], style
        profile = 1e-6 * p0 * np.sqrt(1 - (line / a) ** 2)
        curves[f"Hertz, {name}"] = np.degrees(np.arcsin(line / R2)), profile, f"{style[:2]}-"

# With elements half as large (`meshes/ball_in_socket.py --element-size 2.5e-4`), radius and
# largest pressure under the largest force are

finer = 34.75e-3, 15.36e6
if comm.rank == 0:
    a, p0 = finer
    print(f"to the finer mesh: radius {radii[-1] / a - 1:+.2%}, pressure {peaks[-1] / p0 - 1:+.2%}")

# ## Pictures

stress = von_mises(mesh, sigma(uh))
draw_profile(
    results / "ball_in_socket_pressure.png",
    curves,
    xlabel="angle from the axis [degrees]",
    ylabel="normal pressure [MPa]",
    title="Ball in a socket: contact pressure",
)
draw_deformed(
    results / "ball_in_socket.png",
    uh,
    stress,
    label="von Mises stress",
    unit="MPa",
    scale=1,
    title="Ball in a socket under the largest force, in the plane of a meridian",
)
