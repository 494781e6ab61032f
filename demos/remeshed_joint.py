r"""A pin in a lug, meshed anew with the cell sizes that an error of 1 % needs.

# New meshes of a joint

A pin that contact alone holds is pulled through a lug, with a clearance of 1 % of its radius; by
symmetry half of it is meshed, in plane strain. Facets along curved surfaces should not be refined:
those of both surfaces would no longer match, and pressures would oscillate. Instead Gmsh meshes the
true circles anew, with the cell sizes that `mesh_error` proposes.

This demo illustrates how to

- draw bodies with Gmsh, and mesh them again and again;
- give Gmsh the cell sizes for a wanted error of the mesh;
- let `adapt` do it until the error is small enough, with curved cells of degree 2.

Run it by `python demos/remeshed_joint.py`, or on several processes by
`mpirun -n 2 python demos/remeshed_joint.py`; it draws pictures into `results/`. Lengths are those
of the pin's radius, stresses are relative to Young's modulus.
"""

import tempfile
from pathlib import Path

from mpi4py import MPI

import gmsh
import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, adapt
from fenics_tfeti.io import (
    displacement_space,
    draw_deformed,
    draw_profile,
    read_msh,
    set_mesh_sizes,
)
from fenics_tfeti.models import isotropic, symmetry_plane

results = Path("results")
comm = MPI.COMM_WORLD

# ## Geometry
#
# The lug has an outer radius of 2 and is fixed at a distance of 6; all that is above the axis of
# symmetry is meshed. Physical groups are bodies and surfaces.

radius, clearance, outer, length = 1.0, 0.01, 2.0, 6.0
LUG, PIN, FIXED, SYMMETRY, HOLE, SURFACE = 1, 2, 11, 12, 13, 14


def draw():
    """Draw lug and pin with Gmsh, on one process."""
    occ = gmsh.model.occ
    eye = [(2, occ.addDisk(0, 0, 0, outer, outer))]
    lug, _ = occ.fuse(eye, [(2, occ.addRectangle(-length, -outer, 0, length, 2 * outer))])
    hole = radius + clearance
    lug, _ = occ.cut(lug, [(2, occ.addDisk(0, 0, 0, hole, hole))])
    pin = [(2, occ.addDisk(0, 0, 0, radius, radius))]
    upper = (-2 * length, 0, 0, 4 * length, length)
    lug, pin = (occ.intersect(part, [(2, occ.addRectangle(*upper))])[0] for part in (lug, pin))
    occ.synchronize()
    surfaces = {}
    for tag, parts, name in ((LUG, lug, "lug"), (PIN, pin, "pin")):
        gmsh.model.addPhysicalGroup(2, [body for _, body in parts], tag)
        gmsh.model.setPhysicalName(2, tag, name)
        for _, curve in gmsh.model.getBoundary(parts, oriented=False):
            left, low, _, right, high, _ = gmsh.model.getBoundingBox(1, curve)
            if high < 1e-4:
                surfaces.setdefault(SYMMETRY, []).append(curve)
            elif right < 1e-4 - length:
                surfaces.setdefault(FIXED, []).append(curve)
            elif max(-left, right) < radius + 2 * clearance:
                surfaces.setdefault(SURFACE if tag == PIN else HOLE, []).append(curve)
    for tag, curves in surfaces.items():
        gmsh.model.addPhysicalGroup(1, curves, tag)


def new_mesh(sizes=None):
    """Return a mesh with curved cells, of one size or of the sizes of a function."""
    with tempfile.TemporaryDirectory() as folder:
        file = comm.bcast(str((Path(folder) / "parts").with_suffix(".msh")))
        if comm.rank == 0:
            gmsh.initialize()
            gmsh.option.setNumber("General.Terminal", 0)
            draw()
            gmsh.option.setNumber("Mesh.MeshSizeMax", 0.3 if sizes is None else 1.0)
        if sizes is not None:
            set_mesh_sizes(sizes)
        if comm.rank == 0:
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(2)
            gmsh.write(file)
            gmsh.finalize()
        mesh = read_msh(file, comm, gdim=2)
        comm.barrier()
    return mesh


# ## The problem on a mesh
#
# A force on the volume of the pin pulls it to the right. The clearance is exact, also between
# facets that are not quite on the circles.


def problem_on(parts):
    """Return the problem on a mesh with tags."""
    mesh, tags = parts.mesh, parts.facet_tags
    V = displacement_space(mesh, 2)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(1.0, 0.3)(u), ufl.grad(v)) * ufl.dx
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=parts.cell_tags)
    L = fem.Constant(mesh, 2e-3) * v[0] * dx(PIN)
    fixed = fem.locate_dofs_topological(V, 1, tags.find(FIXED))
    bcs = [
        symmetry_plane(V, tags, SYMMETRY, axis=1),
        fem.dirichletbc(np.zeros(2), fixed, V),
    ]
    pair = ContactPair(tags, slave=SURFACE, master=HOLE, initial_gap=clearance, name="joint")
    return ContactProblem(a, L, bcs=bcs, contacts=[pair], cell_tags=parts.cell_tags)


# ## Meshes until the error is 1 %

problem, estimate, levels = adapt(
    problem_on, new_mesh(), error=0.01, remesh=new_mesh, print_progress=True
)
joint = problem.results["joint"].gather()
if comm.rank == 0:
    print(problem.report.mesh_error)
    print(f"largest pressure: {1e3 * joint.pressure.max():.3g} thousandths of Young's modulus")

# ## Pictures

draw_deformed(
    results / "remeshed_joint.png",
    problem.u,
    estimate.density,
    label="density of the error (log10)",
    title="Pin in a lug: the last mesh, and where its error is",
    scale=1,
)
angle = np.degrees(np.arctan2(joint.coordinates[:, 1], joint.coordinates[:, 0]))
order = np.argsort(angle)
draw_profile(
    results / "remeshed_joint_pressure.png",
    {"last mesh": (angle[order], 1e3 * joint.pressure[order], "o-")},
    xlabel="angle from the direction of the pull [degrees]",
    ylabel="pressure [thousandths of E]",
    title="Pin in a lug: bearing pressure",
)
