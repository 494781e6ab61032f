"""Contact at the price of a linear solve: products with F of each method, on four problems.

    python benchmarks/products.py [--problems beams stack] [--rtol 1e-4 1e-8] [--json out.json]

Each contact problem is solved by SMALBE-M (with the standard and the projected expansion step) and
by the active set method, with each preconditioner. The linear problem beside it has the contact
rows that press in the solution as equalities and the others removed; it is solved from nothing, by
the same preconditioned conjugate gradients to the same tolerance.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

from mpi4py import MPI

import beams
import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.fem.fields import displacement_space
from fenics_tfeti.fem.mesh_io import read_msh
from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.active_set import solve_on_face
from fenics_tfeti.feti.coarse import Projector
from fenics_tfeti.qp import Products

meshes = Path(__file__).parent.parent / "meshes"
METHODS = {
    "smalbe, standard": {"method": "smalbe", "expansion": "standard"},
    "smalbe, projected_cg": {"method": "smalbe", "expansion": "projected_cg"},
    "active_set": {"method": "active_set"},
}
PRECONDITIONERS = ("none", "lumped", "dirichlet")


def elasticity(V, young: float, poisson: float):
    """Return the bilinear form of an isotropic material."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu = fem.Constant(V.mesh, young / (2 * (1 + poisson)))
    lmbda = fem.Constant(V.mesh, young * poisson / ((1 + poisson) * (1 - 2 * poisson)))

    def strain(w):
        return ufl.sym(ufl.grad(w))

    stress = lmbda * ufl.tr(strain(u)) * ufl.Identity(3) + 2 * mu * strain(u)
    return ufl.inner(stress, strain(v)) * ufl.dx


def two_beams() -> ContactProblem:
    """Return the two beams, 32 cubes of 8^3 elements."""
    arguments = argparse.Namespace(
        subdomains_per_metre=2, elements_per_subdomain=8, rtol=1e-6, plain=False
    )
    return beams.build(arguments)


def hertz(cells: str) -> ContactProblem:
    """Return the ball on a plane of demos/hertz_ball.py."""
    ball = read_msh(meshes / f"hertz_ball_{cells}.msh")
    tags, facet_tags = ball.names, ball.facet_tags
    V = displacement_space(ball.mesh)
    v = ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=ball.mesh, subdomain_data=facet_tags)
    traction = fem.Constant(ball.mesh, -4.8e5)
    bcs = []
    for component, plane in ((0, "symmetry_x"), (1, "symmetry_y")):
        part = V.sub(component)
        dofs = fem.locate_dofs_topological(part, 2, facet_tags.find(tags[plane]))
        bcs.append(fem.dirichletbc(0.0, dofs, part))
    ground = RigidObstacle(facet_tags, tags["contact"], Plane((0, 0, 0), (0, 0, 1)))
    load = traction * v[2] * ds(tags["flat"])
    return ContactProblem(elasticity(V, 2e9, 0.3), load, bcs=bcs, contacts=[ground])


def stack() -> ContactProblem:
    """Return the 27 loose blocks of demos/stack_of_blocks.py."""
    blocks = read_msh(meshes / "stack_of_blocks.msh")
    mesh, facet_tags, tags = blocks.mesh, blocks.facet_tags, blocks.names
    V = displacement_space(mesh)
    v, x = ufl.TestFunction(V), ufl.SpatialCoordinate(mesh)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    top = tuple(tags[f"{i} {j} 3 +z"] for i, j in itertools.product((1, 2, 3), repeat=2))
    weight = fem.Constant(mesh, -24e3)
    load = weight * v[2] * ufl.dx - 20e6 * (x[0] / 3 * x[1] / 3) ** 4 * v[2] * ds(top)
    contacts: list[ContactPair | RigidObstacle] = []
    for cube, axis in itertools.product(itertools.product((1, 2, 3), repeat=3), range(3)):
        letter, e = "xyz"[axis], np.eye(3, dtype=int)[axis]
        lower, upper = (tags[f"{{}} {{}} {{}} {side}{letter}".format(*cube)] for side in "-+")
        if cube[axis] < 3:
            other = tags["{} {} {} -{}".format(*(cube + e), letter)]
            contacts.append(ContactPair(facet_tags, slave=other, master=upper))
        elif axis < 2:
            contacts.append(RigidObstacle(facet_tags, upper, Plane(3.0 * e, -1.0 * e)))
        if cube[axis] == 1:
            contacts.append(RigidObstacle(facet_tags, lower, Plane(0.0 * e, 1.0 * e)))
    return ContactProblem(elasticity(V, 30e9, 0.2), load, contacts=contacts)


PROBLEMS = {
    "beams": two_beams,
    "hertz": lambda: hertz("hexahedra"),
    "hertz_tetrahedra": lambda: hertz("tetrahedra"),
    "stack": stack,
}


def linear_products(solver: TornSolver, multipliers: np.ndarray, rtol: float) -> Products:
    """Count what the linear problem on the final active set costs from a zero start."""
    problem, constraints = solver.dual_problem(), solver.constraints
    space, products = constraints.multipliers.space, Products()
    # ||b|| of (11.47), as the contact problem's stopping test takes it
    b = solver.F.load(solver.load - solver.F.constraint_forces(solver.start))
    tolerance = rtol * space.norm(solver.projector.complement(b))
    active = multipliers[constraints.inequality] > 0.0
    face = Projector.build(solver.space, active)
    limit, start = solver.options.max_products, np.zeros_like(multipliers)
    solve_on_face(face, active, problem, start, (0.0, tolerance), limit, products)
    return products


def measure(system: TornSystem, preconditioner: str, rtol: float) -> list[dict]:
    """Return a row for each method."""
    rows, linear = [], None
    for method in reversed(METHODS):
        options = Options(rtol=rtol, preconditioner=preconditioner, **METHODS[method])
        solver = TornSolver(system, options)
        solution = solver.solve()
        if linear is None:
            linear = linear_products(solver, solution.multipliers, rtol)
        spent, report = solution.report.products, solution.report
        rows.append(
            {
                "rtol": rtol,
                "preconditioner": preconditioner,
                "method": method,
                "F": spent["total"],
                "M": spent["preconditioner"],
                "linear F": linear.total,
                "linear M": linear.preconditioner,
                "ratio": (spent["total"] + spent["preconditioner"])
                / (linear.total + linear.preconditioner),
                "faces": len(report.faces),
                "outer": report.outer_iterations,
                "certificate": report.certificate.worst,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument("--rtol", nargs="+", type=float, default=[1e-4, 1e-8])
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    table = []
    if MPI.COMM_WORLD.rank == 0:
        print("problem            rtol  prec.      method                  F    M  linear  ratio")
    for name in arguments.problems:
        problem = PROBLEMS[name]()  # owns the communicator of its torn system
        for rtol, preconditioner in itertools.product(arguments.rtol, PRECONDITIONERS):
            for row in measure(problem.system, preconditioner, rtol):
                table.append({"problem": name, **row})
                if MPI.COMM_WORLD.rank == 0:
                    print(
                        f"{name:<17} {rtol:.0e}  {preconditioner:<9}  {row['method']:<20} "
                        f"{row['F']:>4} {row['M']:>4} {row['linear F']:>3} {row['linear M']:>3} "
                        f"{row['ratio']:6.2f}  faces {row['faces']} outer {row['outer']}",
                        flush=True,
                    )
    if arguments.json and MPI.COMM_WORLD.rank == 0:
        Path(arguments.json).write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
