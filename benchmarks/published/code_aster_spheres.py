"""Code_Aster SSNV104: two equal elastic spheres pressed together, in the plane of a meridian.

    python benchmarks/published/code_aster_spheres.py

Spheres of radius 50 mm (E = 20 GPa, nu = 0.3), whose middle planes approach each other by 4 mm.
Published, from Hertz's formulas: pressure 2798.3 MPa in the centre of the contact. Its radius,
10 mm, is not small beside that of the spheres, so that linear elasticity of half spheres gives
more. Millimetres, newtons, megapascals.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from mpi4py import MPI

import gmsh
import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, read_msh
from fenics_tfeti.models import axisymmetric_strain, isotropic, symmetry_plane

R, YOUNG, POISSON, APPROACH = 50.0, 20e3, 0.3, 4.0
SIDES = {"upper": 1, "lower": -1}


def meridian(path: str) -> None:
    """Make the mesh of a quarter of a disc for each half sphere."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    occ, model, tags = gmsh.model.occ, gmsh.model, dict[str, tuple[int, list[int]]]()
    for name, side in SIDES.items():
        pole, centre = occ.addPoint(0, 0, 0), occ.addPoint(0, side * R, 0)
        rim = occ.addPoint(R, side * R, 0)
        lines = [occ.addLine(pole, centre), occ.addLine(centre, rim)]
        arc = occ.addCircleArc(rim, centre, pole)
        face = occ.addPlaneSurface([occ.addCurveLoop([*lines, arc])])
        tags |= {name: (2, [face]), f"{name}_axis": (1, lines[:1])}
        tags |= {f"{name}_plane": (1, lines[1:]), f"{name}_arc": (1, [arc])}
    occ.synchronize()
    for name, (dim, entities) in tags.items():
        model.setPhysicalName(dim, model.addPhysicalGroup(dim, entities), name)
    # the upper sphere's elements are larger: nodes do not match
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", "0.55+0.005*y+0.15*Max(Sqrt(x*x+y*y)-14,0)")
    model.mesh.field.setAsBackgroundMesh(size)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    model.mesh.generate(2)
    model.mesh.setOrder(2)
    gmsh.write(path)
    gmsh.finalize()


with TemporaryDirectory() as folder:
    path = str(Path(folder) / "spheres.msh")
    meridian(path)
    bodies = read_msh(path, MPI.COMM_SELF, gdim=2)
mesh, facets, tags = bodies.mesh, bodies.facet_tags, bodies.names
V = displacement_space(mesh, degree=2)
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]
bcs = [symmetry_plane(V, facets, tags[f"{name}_axis"], axis=0) for name in SIDES]
for name, side in SIDES.items():
    dofs = fem.locate_dofs_topological(V.sub(1), 1, facets.find(tags[f"{name}_plane"]))
    value = -side * APPROACH / 2
    bcs.append(fem.dirichletbc(fem.Constant(mesh, value), dofs, V.sub(1)))
sigma = isotropic(YOUNG, POISSON, axisymmetric_strain)
problem = ContactProblem(
    ufl.inner(sigma(u), axisymmetric_strain(v)) * weight * ufl.dx,
    0.0,
    bcs=bcs,
    contacts=[ContactPair(facets, slave=tags["lower_arc"], master=tags["upper_arc"])],
    measure_weight=weight,
    options={"units": "mm-N-MPa"},
)
problem.solve()
contact = problem.results[0]
r, p = contact.coordinates[:, 0], contact.pressure
inner = (p > 0.3 * p.max()) & (r > 0.0)
slope, intercept = np.polyfit(r[inner] ** 2, p[inner] ** 2, 1)
a, p0 = np.sqrt(-intercept / slope), np.sqrt(intercept)
print(f"pressure {p0:8.2f} MPa, published 2798.3   {p0 / 2798.3 - 1:+.2%}")
print(f"radius   {a:8.3f} mm,  Hertz     10.0   {a / 10 - 1:+.2%}")
print(f"{problem.report.products['total']} products with F")
