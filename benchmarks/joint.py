"""A fork, a lug and a pin with clearance on tetrahedra of Gmsh: what a first joint gives.

    python benchmarks/joint.py [--element-size 1.5] [--degree 1] [--exchange] [--initial-gap 0.02]

The lug is pulled by 5,292 N, the pin is loose, nothing has friction; lengths in mm, forces in N.
Prints for each contact the largest pressure, and for lug and pin how far they move along the pin.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem
from fenics_tfeti.io import displacement_space, read_msh

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "meshes"))

PULL = 5292.0  # [N]


def read_joint(size: float, degree: int, comm: MPI.Intracomm = MPI.COMM_WORLD) -> Any:
    """Mesh the joint on rank 0 and read it on all."""
    from pin_joint import pin_joint

    folder = tempfile.mkdtemp() if comm.rank == 0 else ""
    path = Path(comm.bcast(folder)) / "joint.msh"
    if comm.rank == 0:
        pin_joint(path, size, degree)
    comm.barrier()
    return read_msh(path, comm)


def joint_problem(
    bodies: Any, degree: int, exchange: bool = False, spring: float = 0.0, **of_pair: Any
) -> ContactProblem:
    """Return the problem; slaves are the holes, or with roles exchanged the pin."""
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
    L = fem.Constant(mesh, PULL / area) * v[0] * ds(names["lug end"])
    held = fem.locate_dofs_topological(V, 2, tags.find(names["fork end"]))
    pairs = []
    for hole in ("lug", "fork"):
        slave, master = names[f"{hole} surface"], names["pin surface"]
        if exchange:
            slave, master = master, slave
        pairs.append(ContactPair(tags, slave, master, name=f"pin in {hole}", **of_pair))
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


def main() -> None:
    """Run one case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--element-size", type=float, default=1.5, help="[mm]")
    parser.add_argument("--degree", type=int, default=1, choices=(1, 2))
    parser.add_argument("--exchange", action="store_true", help="the pin is the slave")
    parser.add_argument("--initial-gap", type=float, help="prescribed clearance [mm]")
    given = parser.parse_args()
    bodies = read_joint(given.element_size, given.degree)
    of_pair = {} if given.initial_gap is None else {"initial_gap": given.initial_gap}
    problem = joint_problem(bodies, given.degree, given.exchange, **of_pair)
    uh = problem.solve()
    motion, results = axial_motion(bodies, uh), [contact.gather() for contact in problem.contact]
    if bodies.mesh.comm.rank:
        return
    print(problem.report)
    for result in results:
        print(f"{result.name}: largest pressure {result.pressure.max():.0f} MPa, ", end="")
        print(f"{result.active.sum()} nodes press")
    print("along the pin: " + ", ".join(f"{name} {z:.4f} mm" for name, z in motion.items()))


if __name__ == "__main__":
    main()
