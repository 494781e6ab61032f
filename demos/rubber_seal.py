r"""A rubber ring is squeezed in its groove until it fills it: Poisson's ratio 0.499.

# Rubber seal

A ring of rubber of rectangular section lies in a groove, and a lid squeezes it. Rubber keeps its
volume: the ring widens until it touches both walls. From then on the lid works against the bulk
modulus, a thousand times as large as that of shear. There is no friction, so that the strains are
nearly the same everywhere, and the mean pressure on the lid is that of Hooke's law,

$$p = -(\lambda \operatorname{tr} \varepsilon + 2 \mu \varepsilon_{zz})$$

with epsilon_zz = -squeeze / h and, once the walls are touched, tr(epsilon) by the clearances.

Displacements of degree 1 lock in such materials. On quadrilaterals and hexahedra the remedy is to
integrate the volumetric term by one point of each cell. The solver finds by itself that the
material is nearly incompressible, and chooses a preconditioner for it.

This demo illustrates how to

- write the form of a nearly incompressible material, in the plane of a meridian and in space;
- use rigid obstacles that are hollow, as the outer wall of a groove;
- compute the force of a lid for several positions.

Run it by `python demos/rubber_seal.py`, or on several processes by
`mpirun -n 2 python demos/rubber_seal.py`; it writes pictures into `results/`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl

from fenics_tfeti import ContactProblem, Cylinder, Plane, RigidObstacle
from fenics_tfeti.io import Box, boxes, displacement_space, draw_deformed, draw_profile, tag_facets
from fenics_tfeti.models import axisymmetric_strain, small_strain, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Data
#
# The ring has the inner radius a, the width w and the height h; between it and the walls of the
# groove there are clearances.

E, nu = 6e6, 0.499
mu, lmbda = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
a, w, h = 20e-3, 3e-3, 3e-3
clearance = {"inner": 0.02e-3, "outer": 0.08e-3}
SIDES = {"floor": 1, "lid": 2, "inner": 3, "outer": 4}
X, Y = 5, 6  # planes of symmetry
one_point = {"quadrature_degree": 0}


def stiffness(V, strain, weight=1):
    """Return the form: the shear term with all points, the volumetric term with one."""
    e, d = strain(ufl.TrialFunction(V)), strain(ufl.TestFunction(V))
    shear = 2 * mu * ufl.inner(e, d) * weight * ufl.dx
    return shear + lmbda * ufl.tr(e) * ufl.tr(d) * weight * ufl.dx(metadata=one_point)


def sides(r, z):
    """Return the markers of the four sides, for functions of points that give r and z."""
    return {
        SIDES["floor"]: lambda x: np.isclose(z(x), 0.0),
        SIDES["lid"]: lambda x: np.isclose(z(x), h),
        SIDES["inner"]: lambda x: np.isclose(r(x), a),
        SIDES["outer"]: lambda x: np.isclose(r(x), a + w),
    }


# ## In the plane of the meridian
#
# Walls, floor and lid are lines.


def meridian(squeeze, n=12):
    """Return the problem for a position of the lid, with n cells along the width."""
    ring = boxes(comm, [Box((a, 0), (a + w, h), (n, n), name="ring")], "quadrilateral")
    mesh = ring.mesh
    facet_tags = tag_facets(mesh, sides(lambda x: x[0], lambda x: x[1]))
    weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]
    form = stiffness(displacement_space(mesh), axisymmetric_strain, weight)
    groove = {
        "floor": Plane((0, 0), (0, 1)),
        "lid": Plane((0, h - squeeze), (0, -1)),
        "inner": Plane((a - clearance["inner"], 0), (1, 0)),
        "outer": Plane((a + w + clearance["outer"], 0), (-1, 0)),
    }
    contacts = [
        RigidObstacle(facet_tags, slave=SIDES[side], obstacle=wall) for side, wall in groove.items()
    ]
    return ContactProblem(form, 0, contacts=contacts, measure_weight=weight)


# ## In space
#
# A quarter of the ring: a box that is bent. Floor and lid are planes, the walls cylinders, the
# outer one hollow.


def quarter(squeeze, n=6, around=48):
    """Return the problem for a position of the lid, with n cells along the width."""
    ring = boxes(comm, [Box((a, 0, 0), (a + w, np.pi / 2, h), (n, around, n), name="ring")])
    mesh = ring.mesh
    markers = sides(lambda x: x[0], lambda x: x[2])
    markers[Y] = lambda x: np.isclose(x[1], 0.0)
    markers[X] = lambda x: np.isclose(x[1], np.pi / 2)
    facet_tags = tag_facets(mesh, markers)
    r, angle = mesh.geometry.x[:, 0].copy(), mesh.geometry.x[:, 1].copy()
    mesh.geometry.x[:, 0], mesh.geometry.x[:, 1] = r * np.cos(angle), r * np.sin(angle)

    V = displacement_space(mesh)
    bcs = [symmetry_plane(V, facet_tags, tag, axis) for axis, tag in enumerate((X, Y))]
    axis = {"point": (0, 0, 0), "axis": (0, 0, 1)}
    groove = {
        "floor": Plane((0, 0, 0), (0, 0, 1)),
        "lid": Plane((0, 0, h - squeeze), (0, 0, -1)),
        "inner": Cylinder(radius=a - clearance["inner"], **axis),
        "outer": Cylinder(radius=a + w + clearance["outer"], hollow=True, **axis),
    }
    contacts = [
        RigidObstacle(facet_tags, slave=SIDES[side], obstacle=wall) for side, wall in groove.items()
    ]
    return ContactProblem(stiffness(V, small_strain), 0, bcs=bcs, contacts=contacts)


# ## Force of the lid
#
# The groove is full when the lid has squeezed out the volume of the clearances.


def hooke(squeeze):
    """Return the mean pressure on the lid, the groove being full, for small strains."""
    widening = 2 * (clearance["outer"] * (a + w) + clearance["inner"] * a) / ((a + w) ** 2 - a**2)
    return -(lmbda * (widening - squeeze / h) - 2 * mu * squeeze / h)


squeezes = 1e-3 * np.array([*np.arange(0.01, 0.095, 0.01), *np.arange(0.092, 0.121, 0.004)])
lid = list(SIDES).index("lid")
forces = []
for squeeze in squeezes:
    problem = meridian(squeeze)
    problem.solve()
    forces.append(problem.report.contacts[lid].normal_force)
area = np.pi * ((a + w) ** 2 - a**2)
p, exact = forces[-1] / area, hooke(squeezes[-1])
in_space, forces_3d = squeezes[[5, 10, 13, -1]], []
for squeeze in in_space:
    problem = quarter(squeeze)
    uh = problem.solve()
    report = problem.report
    forces_3d.append(4 * report.contacts[lid].normal_force)
force_3d = forces_3d[-1]
if comm.rank == 0:
    print(f"{report.unknowns['primal']} unknowns, {report.products['total']} products")
    print(f"mean pressure on the lid {1e-6 * p:.3f} MPa, by Hooke's law {1e-6 * exact:.3f} MPa")
    print(f"force in the meridian's plane {forces[-1]:.1f} N, in space {force_3d:.1f} N")

# ## Pictures

draw_profile(
    results / "rubber_seal_force.png",
    {
        "meridian": (1e3 * squeezes, 1e-3 * np.array(forces), "o-"),
        "space": (1e3 * in_space, 1e-3 * np.array(forces_3d), "s"),
    },
    xlabel="squeeze of the lid [mm]",
    ylabel="force of the lid [kN]",
    title="A ring of rubber fills its groove",
    comm=comm,
)
draw_deformed(
    results / "rubber_seal.png",
    uh,
    label="displacement",
    unit="mm",
    title="A quarter of the ring, squeezed by 4 %",
)
