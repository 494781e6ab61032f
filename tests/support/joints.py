"""A lug that hangs on a loose pin in a fork, meshed by Gmsh: meshes/pin_joint.py."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from mesh_arrays import of_script
from msh_files import gmsh_model
from scenes import Scene, integral

import ufl
from dolfinx import fem

from fenics_tfeti import ContactProblem, ContactResult, Mortar
from fenics_tfeti.io import read_msh

# [N], [mm], of the pin [mm], [MPa]
PULL, CLEARANCE, RADIUS, YOUNG = 5292.0, 0.02, 5.0, 2.1e5


def read_joint(size: float, degree: int, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Any:
    """Mesh the joint on rank 0 and read it on all."""
    return of_script("pin_joint", 3, size, degree, comm=comm)


def joint_problem(
    bodies: Any, degree: int, exchange: bool = False, along: float = 0.0, **of_pair: Any
) -> ContactProblem:
    """Return the problem; slaves are the holes, or with roles exchanged the pin.

    `along` is the traction along the pin, relative to that across.
    """
    names = bodies.names
    scene = Scene.of(bodies, degree=degree, young=YOUNG)
    v, end = scene.v, scene.ds(names["lug end"])
    area = integral(scene.mesh, bodies.facet_tags, names["lug end"])
    scene.L = scene.constant(PULL / area) * (v[0] + along * v[2]) * end
    scene.fix(names["fork end"])
    for hole in ("lug", "fork"):
        slave, master = names[f"{hole} surface"], names["pin surface"]
        if exchange:
            slave, master = master, slave
        scene.add_pair(slave, master, name=f"pin in {hole}", **{"roles": "given", **of_pair})
    return scene.problem(cell_tags=None)


def axial_motion(bodies: Any, uh: fem.Function) -> dict[str, float]:
    """Return the mean displacements of lug and pin along the pin [mm]."""
    mesh, motion = uh.function_space.mesh, {}
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=bodies.cell_tags)
    one = fem.Constant(mesh, 1.0)
    for name in ("lug", "pin"):
        forms = (uh[2] * dx(bodies.names[name]), one * dx(bodies.names[name]))
        moved, volume = (mesh.comm.allreduce(fem.assemble_scalar(fem.form(form))) for form in forms)
        motion[name] = moved / volume
    return motion


def largest_mean_pressure(contact: ContactResult, low: float, high: float) -> float:
    """Return the largest mean over 30 degrees and a quarter of the width of a hole [MPa].

    Its edges are at |z| = low and high; of the fork both tines are taken together. The force at a
    node is spread over a square of its area.
    """
    x, side = contact.coordinates, np.sqrt(contact.area)[:, None, None]
    spread = (np.arange(8) + 0.5) / 8.0 - 0.5
    z = x[:, 2, None, None] + side * spread[:, None]
    radius = np.hypot(x[:, 0], x[:, 1])[:, None, None]
    angle = np.arctan2(x[:, 1], np.abs(x[:, 0]))[:, None, None] + side * spread / radius
    z, angle = np.broadcast_arrays(np.clip(np.abs(z), low, high), angle)
    edges = (
        np.linspace(-np.pi / 3.0, np.pi / 3.0, 5),
        np.linspace(low, high, 3 if low == 0.0 else 5),
    )
    force = np.repeat(contact.pressure * contact.area / spread.size**2, spread.size**2)
    forces, *_ = np.histogram2d(angle.ravel(), z.ravel(), edges, weights=force)
    area = 2.0 * radius.mean() * np.diff(edges[0])[0] * np.diff(edges[1])[0]
    return float(forces.max() / area)


def plane_joint(size: float, degree: int, exchange: bool = False, **of_pair: Any) -> ContactProblem:
    """Return a pin that 540 N/mm press into the hole of a lug, on triangles in the plane."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plane.msh"
        _plane_mesh(path, size, degree)
        bodies = read_msh(path, MPI.COMM_SELF, gdim=2)
    names = bodies.names
    scene = Scene.of(bodies, degree=degree, young=YOUNG)
    dx = scene.dx(names["pin"])
    area = integral(scene.mesh, bodies.cell_tags, names["pin"], "dx")
    scene.L = -scene.constant(540.0 / area) * scene.v[0] * dx
    scene.fix(names["lug end"])
    # nothing but facets resists the pin's rotation
    part = scene.V.sub(1)
    along_y, _ = part.collapse()
    point = fem.locate_dofs_geometrical(
        (part, along_y), lambda x: np.hypot(x[0] - RADIUS, x[1]) < 1e-9
    )
    scene.bcs.append(fem.dirichletbc(fem.Function(along_y), point, part))
    slave, master = names["lug surface"], names["pin surface"]
    if exchange:
        slave, master = master, slave
    scene.add_pair(slave, master, partners=Mortar(), roles="given", **of_pair)
    return scene.problem(cell_tags=None)


def _plane_mesh(path: Path, size: float, order: int) -> None:
    with gmsh_model(path, 2, order) as gmsh:
        occ = gmsh.model.occ
        pin = occ.addDisk(0, 0, 0, RADIUS, RADIUS)
        plate, end = occ.addRectangle(0, -9, 0, 30, 18), occ.addDisk(0, 0, 0, 9, 9)
        hole = occ.addDisk(0, 0, 0, RADIUS + CLEARANCE, RADIUS + CLEARANCE)
        whole, _ = occ.fuse([(2, plate)], [(2, end)])
        ((_, lug),), _ = occ.cut(whole, [(2, hole)])
        occ.synchronize()
        named: dict[str, list[int]] = {}
        for name, body in (("pin", pin), ("lug", lug)):
            gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, [body]), name)
            for _, side in gmsh.model.getBoundary([(2, body)], oriented=False):
                x0, _, _, x1, y1, _ = gmsh.model.getBoundingBox(1, side)
                if x0 > 29.0:
                    named["lug end"] = [side]
                elif max(-x0, x1, y1) < RADIUS + 2.0 * CLEARANCE:
                    named.setdefault(f"{name} surface", []).append(side)
        for name in sorted(named):
            gmsh.model.setPhysicalName(1, gmsh.model.addPhysicalGroup(1, named[name]), name)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
