r"""A lug on a pin in a fork, drawn in CAD, and meshed anew until the error of the mesh is 3 %.

# New meshes of a joint

A lug is pulled, and hangs on a loose pin in a fork; by symmetry a quarter is meshed. Facets along
curved surfaces should not be refined: those of both surfaces would no longer match, and pressures
would oscillate. Instead Gmsh meshes the true cylinders anew, with the cell sizes that `mesh_error`
proposes.

This demo illustrates how to

- draw bodies with the CAD kernel of Gmsh, and mesh them again and again;
- give Gmsh the cell sizes for a wanted error of the mesh;
- let `adapt` do it until the error is small enough, with curved cells of degree 2;
- see on a still finer mesh how good a pressure is.

Run it by `python demos/remeshed_joint.py`, or on several processes by
`mpirun -n 2 python demos/remeshed_joint.py`; it draws pictures into `results/`. Lengths are in
millimetres, forces in newtons, stresses in MPa.
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
# The pin's axis is the z axis. The lug extends along x, the fork against x; the holes are wider
# than the pin. The planes y = 0 and z = 0 are those of symmetry.

radius, clearance = 5.0, 0.02
half_lug, beside, tine = 4.9, 0.1, 7.0  # thickness of half the lug, gap beside it, of a tine
half_pin, chamfer = 13.0, 1.0
half_width, length, bridge = 9.0, 30.0, 10.0  # of lug and fork; of the fork's closed end
force = 5292.0
LUG, FORK, PIN = 1, 2, 3
LUG_HOLE, FORK_HOLE, SURFACE, LUG_END, FORK_END, ACROSS, MIDDLE = 11, 12, 13, 14, 15, 16, 17


def eye(sign, low, high):
    """Return a plate with a round end and a hole about the z axis that extends along sign x."""
    occ = gmsh.model.occ
    plate = (3, occ.addBox(min(0.0, sign * length), 0, low, length, half_width, high - low))
    end = (3, occ.addCylinder(0, 0, low, 0, 0, high - low, half_width))
    hole = (3, occ.addCylinder(0, 0, low, 0, 0, high - low, radius + clearance))
    return occ.cut(occ.fuse([plate], [end])[0], [hole])[0]


def draw():
    """Draw a quarter of fork, lug and pin with Gmsh, on one process."""
    occ = gmsh.model.occ
    inner = half_lug + beside
    closed_end = (3, occ.addBox(-length, 0, 0, bridge, half_width, inner))
    rod = (3, occ.addCylinder(0, 0, 0, 0, 0, half_pin - chamfer, radius))
    cone = (3, occ.addCone(0, 0, half_pin - chamfer, 0, 0, chamfer, radius, radius - chamfer))
    whole = {
        "lug": eye(1.0, 0.0, half_lug),
        "fork": occ.fuse(eye(-1.0, inner, inner + tine), [closed_end])[0],
        "pin": occ.fuse([rod], [cone])[0],
    }
    quarter = (-length, 0, 0, 2 * length, half_width, half_pin)
    cut = {name: occ.intersect(b, [(3, occ.addBox(*quarter))])[0] for name, b in whole.items()}
    occ.synchronize()
    surfaces = {}
    for tag, (name, bodies) in enumerate(cut.items(), start=LUG):
        gmsh.model.addPhysicalGroup(3, [body for _, body in bodies], tag)
        gmsh.model.setPhysicalName(3, tag, name)
        for _, face in gmsh.model.getBoundary(bodies, oriented=False):
            surfaces.setdefault(name_of(tag, face), []).append(face)
    for tag, faces in surfaces.items():
        if tag:
            gmsh.model.addPhysicalGroup(2, faces, tag)


def name_of(body, face):
    """Return the tag of a face of a body, 0 if it is free."""
    left, _, _, right, back, top = gmsh.model.getBoundingBox(2, face)
    is_round = gmsh.model.getType(2, face) == "Cylinder"
    if back < 1e-4:
        return ACROSS
    if top < 1e-4:
        return MIDDLE
    # the round ends of lug and fork are wider
    if is_round and max(-left, right) < radius + 2 * clearance:
        return {LUG: LUG_HOLE, FORK: FORK_HOLE, PIN: SURFACE}[body]
    return LUG_END if left > length - 1e-4 else FORK_END if right < 1e-4 - length else 0


def new_mesh(sizes=None):
    """Return a mesh with curved cells, of one size or of the sizes of a function."""
    with tempfile.TemporaryDirectory() as folder:
        file = comm.bcast(str((Path(folder) / "parts").with_suffix(".msh")))
        if comm.rank == 0:
            gmsh.initialize()
            gmsh.option.setNumber("General.Terminal", 0)
            draw()
            gmsh.option.setNumber("Mesh.MeshSizeMax", 2.0 if sizes is None else 4.0)
        if sizes is not None:
            set_mesh_sizes(sizes)
        if comm.rank == 0:
            gmsh.model.mesh.generate(3)
            gmsh.model.mesh.setOrder(2)
            gmsh.write(file)
            gmsh.finalize()
        mesh = read_msh(file, comm, gdim=3)
        comm.barrier()
    return mesh


# ## The problem on a mesh
#
# Only contact holds lug and pin along x. The clearance is exact, also between facets that are not
# quite on the cylinders.


def problem_on(parts):
    """Return the problem on a mesh with tags."""
    mesh, tags = parts.mesh, parts.facet_tags
    V = displacement_space(mesh, 2)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(isotropic(2.1e5, 0.3)(u), ufl.grad(v)) * ufl.dx
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    L = fem.Constant(mesh, 0.25 * force / (half_lug * half_width)) * v[0] * ds(LUG_END)
    bcs = [
        symmetry_plane(V, tags, ACROSS, axis=1),
        symmetry_plane(V, tags, MIDDLE, axis=2),
        fem.dirichletbc(np.zeros(3), fem.locate_dofs_topological(V, 2, tags.find(FORK_END)), V),
    ]
    contacts = [
        ContactPair(tags, slave=hole, master=SURFACE, initial_gap=clearance, name=name)
        for hole, name in ((LUG_HOLE, "pin in lug"), (FORK_HOLE, "pin in fork"))
    ]
    return ContactProblem(a, L, bcs=bcs, contacts=contacts, cell_tags=parts.cell_tags)


def pressures(problem):
    """Return angle, distance from the middle and pressure at the nodes of the lug's hole.

    And the bearing pressure in the middle of its width: a mean around the place, with weights that
    fall over 15 degrees and an eighth of the width.
    """
    result = problem.results["pin in lug"].gather()
    x, y, z = result.coordinates.T
    angle = np.degrees(np.arctan2(np.abs(y), -x))
    weights = result.area * np.exp(-((angle / 15.0) ** 2) - (z / (half_lug / 4.0)) ** 2)
    return angle, z, result.pressure, weights @ result.pressure / weights.sum()


# ## Meshes until the error is 3 %

problem, estimate, levels = adapt(
    problem_on,
    new_mesh(),
    error=0.03,
    max_unknowns=250_000,
    remesh=new_mesh,
    print_progress=True,
)
angle, z, pressure, bearing = pressures(problem)
if comm.rank == 0:
    print(problem.report.mesh_error)
    print(f"bearing pressure in the middle: {bearing:.1f} MPa")

# ## A finer mesh
#
# Edges of the lug's hole press into the pin: the pressure there is infinite, and grows with each
# mesh. In the middle of the width it does not change any more.

finer = problem_on(new_mesh(estimate.sizes(0.5 * estimate.error)))
finer.solve()
error, of_finer = finer.mesh_error().error, pressures(finer)
if comm.rank == 0:
    unknowns = finer.report.unknowns["primal"]
    print(f"with {unknowns} unknowns, {100 * error:.2g} %: {of_finer[3]:.1f} MPa")

# ## Pictures

draw_deformed(
    results / "remeshed_joint.png",
    problem.u,
    estimate.density,
    label="density of the error (log10)",
    title="Lug on a pin in a fork: the last mesh, and where its error is",
    scale=20,
)


def near_the_middle(angle, z, pressure):
    """Return a curve of the pressures within an eighth of the width from the middle."""
    order = np.argsort(angle)
    order = order[(np.abs(z) < half_lug / 4.0)[order] & (angle < 90.0)[order]]
    return angle[order], pressure[order], "o"


draw_profile(
    results / "remeshed_joint_pressure.png",
    {
        "last mesh": near_the_middle(angle, z, pressure),
        "finer mesh": near_the_middle(*of_finer[:3]),
    },
    xlabel="angle from the direction of the pull [degrees]",
    ylabel="pressure [MPa]",
    title="Lug on a pin in a fork: pressures at nodes in the middle of the lug's width",
)
