"""A bolt in the hole of a lug, with clearance, on tetrahedra as Gmsh makes them.

# Bolt in a lug

A lug of steel, 12 mm thick, is pulled by 24 kN along x. A bolt of 20 mm diameter through its hole
holds it; outside the lug the bolt is clamped. The hole is wider than the bolt by the clearance c in
radius, and at first they touch on the line x = -10 mm, y = 0 only. The gap at the angle t from that
line is c (1 - cos t).

The bodies are meshed apart. The clearance is as small as the distances of the facets from the
cylinders: hole and bolt are drawn with the same radius, and the gap is prescribed.

This demo illustrates how to

- use a mesh made by Gmsh from constructive solid geometry;
- prescribe a clearance by a function;
- solve a problem again with another contact;
- draw the pressure on a surface that another body hides.

Run it by `python demos/bolt_in_lug.py`, or on several processes by
`mpirun -n 2 python demos/bolt_in_lug.py`; it draws pictures into `results/`. The mesh comes
from `meshes/bolt_in_lug.py`. All units are SI.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, draw_profile, read_msh, von_mises
from fenics_tfeti.models import isotropic, symmetry_plane

here = Path(__file__).parent
results = Path("results")

# ## Mesh
#
# A quarter of lug and bolt: y >= 0 and z >= 0.

bodies = read_msh(here.parent / "meshes" / "bolt_in_lug.msh", MPI.COMM_WORLD)
mesh, facet_tags, tags = bodies.mesh, bodies.facet_tags, bodies.names
radius, half_thickness, half_width, length = 0.01, 0.006, 0.022, 0.06

# ## Linear elasticity

sigma = isotropic(2.1e11, 0.3)
V = displacement_space(mesh)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
pull = 24e3 / 4  # on the quarter
traction = fem.Constant(mesh, pull / (half_width * half_thickness))
a_form = ufl.inner(sigma(u), ufl.grad(v)) * ufl.dx
L_form = traction * v[0] * ds(tags["pulled"])

# ## Supports
#
# Along x, contact alone holds the lug.

clamped = fem.locate_dofs_topological(V, 2, facet_tags.find(tags["clamped"]))
bcs = [fem.dirichletbc(np.zeros(3), clamped, V)]
sides = ("symmetry_y", 1), ("symmetry_z", 2)
bcs += [symmetry_plane(V, facet_tags, tags[name], axis) for name, axis in sides]

# ## Contact
#
# The lug, with the larger elements, is the slave.


def bolt_in_hole(clearance):
    """Return the contact with a clearance in radius [m]."""
    return ContactPair(
        facet_tags,
        slave=tags["lug surface"],
        master=tags["bolt surface"],
        name="bolt in hole",
        initial_gap=lambda x: clearance * (1 + x[0] / radius),
    )


# ## Three clearances
#
# The contact force equals the pull. The mean square of the angle t, weighted by the normal forces,
# shows how the contact area shrinks with the clearance, the displacement of the pulled end how the
# joint softens. `problem.draw` colours by the contact pressure; without the cells of the bolt, and
# with the lug cut beside it, the hole is seen. For each clearance, the angle and the displacement
# with elements of 5/9 the size (`meshes/bolt_in_lug.py --element-size 5e-4`):

finer = {0.0: (48.31, 34.81e-6), 2e-5: (32.25, 42.61e-6), 1e-4: (14.87, 54.77e-6)}

problem = ContactProblem(a_form, L_form, bcs=bcs, contacts=[bolt_in_hole(0.0)])
one = fem.Constant(mesh, 1.0)
area = mesh.comm.allreduce(fem.assemble_scalar(fem.form(one * ds(tags["pulled"]))))
forces, errors, curves = [], [], {}
for (clearance, (finer_angle, finer_end)), style in zip(finer.items(), "os^", strict=True):
    problem.contacts = [bolt_in_hole(clearance)]
    uh = problem.solve()
    nodes = problem.results[0].gather()
    x, y, z = nodes.coordinates.T
    t = np.degrees(np.arctan2(np.abs(y), -x))  # y = -0.0 is in the plane of symmetry
    forces.append(4 * abs(problem.report.contacts[0].force[0]))
    angle = np.sqrt(nodes.nodal_normal_force @ t**2 / nodes.nodal_normal_force.sum())
    end = mesh.comm.allreduce(fem.assemble_scalar(fem.form(uh[0] * ds(tags["pulled"])))) / area
    errors.append((angle / finer_angle - 1, end / finer_end - 1))
    if mesh.comm.rank == 0:
        to_angle, to_end = errors[-1]
        print(
            f"clearance {1e3 * clearance:.2f} mm: force {forces[-1]:.3f} N, angle {angle:.2f}° "
            f"({to_angle:+.2%} to the finer mesh), displacement {1e6 * end:.2f} µm ({to_end:+.2%})"
        )
    middle = np.isclose(z, 0) & (t < 110)
    order = np.argsort(t[middle])
    p = 1e-6 * nodes.pressure[middle][order]
    if clearance == 2e-5:
        problem.draw(
            results / "bolt_in_lug_contact.png",
            cells=bodies.cell_tags.find(tags["lug"]),
            section=((0.014, 0, 0), (1, 0, 0)),
            title="Pressure of the bolt on the hole, clearance 0.02 mm",
            camera=(0.8, -1.0, 0.45),
            scale=50,
        )
    curves[f"clearance {1e3 * clearance:.2f} mm"] = t[middle][order], p, f"{style}-"

# ## Pictures

draw_profile(
    results / "bolt_in_lug_pressure.png",
    curves,
    xlabel="angle from the line of first contact [degrees]",
    ylabel="normal pressure [MPa]",
    title="Bolt in a lug: contact pressure in the middle of the lug",
)
problem.draw(
    results / "bolt_in_lug.png",
    von_mises(mesh, sigma(uh)),
    label="von Mises stress",
    unit="MPa",
    title="A quarter of bolt and lug, clearance 0.1 mm",
    camera=(-0.5, -1.0, 0.9),
)
