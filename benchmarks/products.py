"""Contact at the price of a linear solve: products with F of each method, on four problems.

    python benchmarks/products.py [--problems beams stack] [--rtol 1e-4 1e-8] [--json out.json]

Each contact problem is solved by SMALBE-M (with the standard and the projected expansion step) and
by the active set method, from nothing and from the solution on a mesh with elements twice as large,
with each preconditioner. The linear problem beside it has the contact rows that press in the
solution as equalities and the others removed; it is solved from nothing, by the same preconditioned
conjugate gradients to the same tolerance.

Processor seconds are those of solve() from its set-up on, without meshes and assembly; with the
coarse problem those of both.

Needs Gmsh with its Python module, for the meshes with larger elements.
"""

from __future__ import annotations

import argparse
import itertools
import json
import runpy
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import beams
import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Plane, RigidObstacle
from fenics_tfeti.fem.io.fields import displacement_space
from fenics_tfeti.fem.io.gmsh import TaggedMesh, read_msh
from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.pcpg import Face, pcpg
from fenics_tfeti.qp import Products

meshes = Path(__file__).parent.parent / "meshes"
METHODS = {
    "smalbe, standard": {"method": "smalbe", "mprgp_expansion": "standard"},
    "smalbe, projected_cg": {"method": "smalbe", "mprgp_expansion": "projected_cg"},
    "active_set": {"method": "active_set"},
}
WARM = "active_set, coarse"
PRECONDITIONERS = ("none", "lumped", "dirichlet")
# of the solution on the coarse mesh, whose contact is only as exact as its elements are small
COARSE_RTOL = 1e-4


def elasticity(V, young: float, poisson: float):
    """Return the bilinear form of an isotropic material."""
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu = fem.Constant(V.mesh, young / (2 * (1 + poisson)))
    lmbda = fem.Constant(V.mesh, young * poisson / ((1 + poisson) * (1 - 2 * poisson)))

    def strain(w):
        return ufl.sym(ufl.grad(w))

    stress = lmbda * ufl.tr(strain(u)) * ufl.Identity(3) + 2 * mu * strain(u)
    return ufl.inner(stress, strain(v)) * ufl.dx


def mesh_file(script: str, function: str, name: str, **arguments) -> TaggedMesh:
    """Return a mesh that a script in meshes/ makes."""
    make = runpy.run_path(str(meshes / script))[function]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(MPI.COMM_WORLD.bcast(folder)) / name
        if MPI.COMM_WORLD.rank == 0:
            make(path, **arguments)
        MPI.COMM_WORLD.barrier()
        return read_msh(path)


def two_beams(coarse: bool) -> ContactProblem:
    """Return the two beams, 32 cubes of 8^3 elements, or of 4^3."""
    arguments = argparse.Namespace(
        subdomains_per_metre=2, elements_per_subdomain=4 if coarse else 8, rtol=1e-6, plain=False
    )
    return beams.build(arguments)


def hertz(cell: str, coarse: bool) -> ContactProblem:
    """Return the ball on a plane of demos/hertz_ball.py."""
    size = 1e-3 if coarse else 5e-4
    ball = mesh_file("half_balls.py", "half_balls", "ball.msh", cell=cell, element_size=size)
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


def stack(coarse: bool) -> ContactProblem:
    """Return the 27 loose blocks of demos/stack_of_blocks.py."""
    cells = 2 if coarse else 4
    blocks = mesh_file(
        "stack_of_blocks.py", "stack_of_blocks", "stack.msh", elements_per_block=cells
    )
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


PROBLEMS: dict[str, Callable[[bool], ContactProblem]] = {
    "beams": two_beams,
    "hertz": lambda coarse: hertz("hexahedron", coarse),
    "hertz_tetrahedra": lambda coarse: hertz("tetrahedron", coarse),
    "stack": stack,
}


def linear_products(solver: TornSolver, multipliers: np.ndarray, rtol: float) -> Products:
    """Count what the linear problem on the final active set costs from a zero start."""
    problem, constraints = solver.dual_problem(), solver.setup.constraints
    space, products = constraints.layout.space, Products()
    # ||b|| of (11.47), as the contact problem's stopping test takes it
    b = solver.setup.F.load(
        solver.data.load - solver.setup.F.constraint_forces(solver.data.feasible), solver.data.c
    )
    tolerance = rtol * space.norm(solver.setup.projector.P(b))
    active = multipliers[constraints.inequality] > 0.0
    projector = Projector.build(solver.setup.projector.coarse_space, active)
    limit, start = solver.options.max_products, np.zeros_like(multipliers)
    pcpg(
        problem,
        Face(active, projector),
        start,
        tolerance=tolerance,
        sign_factor=0.0,
        max_products=limit,
        products=products,
    )
    return products


def timed_solve(problem: ContactProblem, coarse: ContactProblem | None = None) -> float:
    """Solve, and return the processor seconds of all ranks."""
    start = time.process_time()
    problem.solve(coarse=coarse)
    return MPI.COMM_WORLD.allreduce(time.process_time() - start)


def with_options(name: str, coarse: bool, **options) -> ContactProblem:
    """Return a new problem with some options."""
    problem = PROBLEMS[name](coarse)
    problem.options = replace(problem.options, solver=replace(problem.options.solver, **options))
    return problem


def row(report, linear: Products, **others) -> dict:
    """Return what is printed of a solve."""
    spent = report.products
    products = spent["total"] + spent["preconditioner"]
    return {
        **others,
        "F": spent["total"],
        "M": spent["preconditioner"],
        "linear F": linear.total,
        "linear M": linear.preconditioner,
        "ratio": products / (linear.total + linear.preconditioner),
        "faces": len(report.faces),
        "outer": report.outer_iterations,
        "certificate": report.certificate.worst,
    }


def measure(name: str, system: TornSystem, preconditioner: str, rtol: float) -> list[dict]:
    """Return a row for each method."""
    given = {"rtol": rtol, "preconditioner": preconditioner}
    rows, linear = [], Products()
    for method in reversed(METHODS):
        solver = TornSolver(system, Options(**given, **METHODS[method]))
        solution = solver.solve()
        if method == "active_set":
            linear = linear_products(solver, solution.multipliers, rtol)
        rows.append(row(solution.report, linear, **given, method=method))
    alone = timed_solve(with_options(name, coarse=False, **given))
    coarse = with_options(name, coarse=True, rtol=COARSE_RTOL, preconditioner=preconditioner)
    fine = with_options(name, coarse=False, **given)
    seconds = timed_solve(coarse) + timed_solve(fine, coarse)
    spent = coarse.report.products
    others = {"coarse F": spent["total"], "coarse M": spent["preconditioner"]}
    timed = {"seconds": seconds, "seconds of active_set": alone}
    rows.append(row(fine.report, linear, **given, method=WARM, **others, **timed))
    return rows


def printed(name: str, entry: dict) -> str:
    """Return a row as a line."""
    line = (
        f"{name:<17} {entry['rtol']:.0e}  {entry['preconditioner']:<9}  {entry['method']:<20} "
        f"{entry['F']:>4} {entry['M']:>4} {entry['linear F']:>3} {entry['linear M']:>3} "
        f"{entry['ratio']:6.2f}  faces {entry['faces']} outer {entry['outer']}"
    )
    if entry["method"] != WARM:
        return line
    times = entry["seconds"] / entry["seconds of active_set"]
    return f"{line} coarse {entry['coarse F']} {entry['coarse M']} seconds {times:.2f}"


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
        problem = PROBLEMS[name](False)  # owns the communicator of its torn system
        for rtol, preconditioner in itertools.product(arguments.rtol, PRECONDITIONERS):
            for entry in measure(name, problem.system, preconditioner, rtol):
                table.append({"problem": name, **entry})
                if MPI.COMM_WORLD.rank == 0:
                    print(printed(name, entry), flush=True)
    if arguments.json and MPI.COMM_WORLD.rank == 0:
        Path(arguments.json).write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
