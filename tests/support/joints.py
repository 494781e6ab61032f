"""A lug that hangs on a loose pin in a fork, meshed by Gmsh: meshes/pin_joint.py."""

from __future__ import annotations

import runpy
import signal
import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, read_msh

MESHES = Path(__file__).resolve().parents[2] / "meshes"
PULL, CLEARANCE = 5292.0, 0.02  # [N], [mm]


def read_joint(size: float, degree: int, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Any:
    """Mesh the joint on rank 0 and read it on all."""
    handler = signal.getsignal(signal.SIGINT)  # Gmsh replaces it
    with tempfile.TemporaryDirectory() as folder:
        path = Path(comm.bcast(folder)) / "joint.msh"
        if comm.rank == 0:
            runpy.run_path(str(MESHES / "pin_joint.py"))["pin_joint"](path, size, degree)
            signal.signal(signal.SIGINT, handler)
        comm.barrier()
        return read_msh(path, comm)


def joint_problem(
    bodies: Any, degree: int, exchange: bool = False, along: float = 0.0, **of_pair: Any
) -> ContactProblem:
    """Return the problem; slaves are the holes, or with roles exchanged the pin.

    `along` is the traction along the pin, relative to that across.
    """
    mesh, tags, names = bodies.mesh, bodies.facet_tags, bodies.names
    E, nu = 2.1e5, 0.3
    mu, lmbda = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    V = displacement_space(mesh, degree=degree)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    eps_u, eps_v = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
    a = (lmbda * ufl.tr(eps_u) * ufl.tr(eps_v) + 2 * mu * ufl.inner(eps_u, eps_v)) * ufl.dx
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    one = fem.Constant(mesh, 1.0)
    area = mesh.comm.allreduce(fem.assemble_scalar(fem.form(one * ds(names["lug end"]))))
    L = fem.Constant(mesh, PULL / area) * (v[0] + along * v[2]) * ds(names["lug end"])
    held = fem.locate_dofs_topological(V, 2, tags.find(names["fork end"]))
    pairs = []
    for hole in ("lug", "fork"):
        slave, master = names[f"{hole} surface"], names["pin surface"]
        if exchange:
            slave, master = master, slave
        chosen = {"roles": "given", **of_pair}
        pairs.append(ContactPair(tags, slave, master, name=f"pin in {hole}", **chosen))
    return ContactProblem(a, L, bcs=[fem.dirichletbc(np.zeros(3), held, V)], contacts=pairs)


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
