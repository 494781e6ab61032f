"""Products with F of each method compared with a linear problem, for four contact problems.

    python benchmarks/run.py products [--problems beams stack] [--rtol 1e-4 1e-8]

Each contact problem is solved by SMALBE-M (with the standard and the projected expansion step) and
by the active set method, from zero multipliers and from the solution on a mesh with elements twice
as large, with each preconditioner. The linear problem has the active contact rows of the solution
as equalities and no other contact rows. It is solved from zero multipliers by the same
preconditioned conjugate gradients to the same tolerance.

Processor seconds are those of solve() with its set-up, without meshes and assembly; with a coarse
problem they are those of both.

Needs Gmsh with its Python module, for the meshes with larger elements.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace

from mpi4py import MPI

import beams
import numpy as np
from mesh_arrays import of_script
from scenes import Scene, elasticity, plane

import ufl

from fenics_tfeti import ContactProblem, Plane
from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.face_operators import FaceOperators
from fenics_tfeti.feti.dual.pcpg import pcpg
from fenics_tfeti.qp import Products

METHODS = {
    "smalbe, standard": {"method": "smalbe", "mprgp_expansion": "standard"},
    "smalbe, projected_cg": {"method": "smalbe", "mprgp_expansion": "projected_cg"},
    "active_set": {"method": "active_set"},
}
WARM = "active_set, coarse"
PRECONDITIONERS = ("none", "lumped", "dirichlet")
# tolerance on the coarse mesh, whose contact has the discretisation error of larger elements
COARSE_RTOL = 1e-4


def two_beams(coarse: bool) -> ContactProblem:
    """Return the two beams, 32 cubes of 8^3 elements, or of 4^3."""
    return beams.build(2, 4 if coarse else 8, 1e-6)


def hertz(cell: str, coarse: bool) -> ContactProblem:
    """Return the ball on a plane of demos/hertz_ball.py."""
    size = 1e-3 if coarse else 5e-4
    ball = of_script("half_balls", 3, cell, size, comm=MPI.COMM_WORLD)
    tags, scene = ball.names, Scene.of(ball)
    scene.a = elasticity(scene.u, scene.v, 2e9, poisson=0.3)
    scene.L = scene.constant(-4.8e5) * scene.v[2] * scene.ds(tags["flat"])
    for component, side in enumerate(("symmetry_x", "symmetry_y")):
        scene.fix(tags[side], component)
    scene.add_obstacle(tags["contact"], plane(2, 3))
    return scene.problem(cell_tags=None)


def stack(coarse: bool) -> ContactProblem:
    """Return the 27 loose blocks of demos/stack_of_blocks.py."""
    blocks = of_script("stack_of_blocks", 3, 3, 2 if coarse else 4, comm=MPI.COMM_WORLD)
    tags, scene = blocks.names, Scene.of(blocks)
    v, x = scene.v, ufl.SpatialCoordinate(scene.mesh)
    top = tuple(tags[f"{i} {j} 3 +z"] for i, j in itertools.product((1, 2, 3), repeat=2))
    scene.a = elasticity(scene.u, v, 30e9, poisson=0.2)
    scene.L = scene.constant(-24e3) * v[2] * ufl.dx
    scene.L -= 20e6 * (x[0] / 3 * x[1] / 3) ** 4 * v[2] * scene.ds(top)
    for cube, axis in itertools.product(itertools.product((1, 2, 3), repeat=3), range(3)):
        letter, e = "xyz"[axis], np.eye(3, dtype=int)[axis]
        lower, upper = (tags[f"{{}} {{}} {{}} {side}{letter}".format(*cube)] for side in "-+")
        if cube[axis] < 3:
            scene.add_pair(tags["{} {} {} -{}".format(*(cube + e), letter)], upper)
        elif axis < 2:
            scene.add_obstacle(upper, Plane(3.0 * e, -1.0 * e))
        if cube[axis] == 1:
            scene.add_obstacle(lower, Plane(0.0 * e, 1.0 * e))
    return scene.problem(cell_tags=None)


PROBLEMS: dict[str, Callable[[bool], ContactProblem]] = {
    "beams": two_beams,
    "hertz": lambda coarse: hertz("hexahedron", coarse),
    "hertz_tetrahedra": lambda coarse: hertz("tetrahedron", coarse),
    "stack": stack,
}


def linear_products(solver: TornSolver, multipliers: np.ndarray, tolerance: float) -> Products:
    """Count what the linear problem on the final active set costs from a zero start."""
    problem, products = solver.dual_problem(), Products()
    projector = Projector.build(problem.coarse_space, problem.face_of(multipliers))
    limit, start = solver.options.max_products, np.zeros_like(multipliers)
    pcpg(
        problem,
        FaceOperators.build(problem, projector),
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
    """Return a row of the table."""
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
            tolerance = solution.report.dual_tolerance
            linear = linear_products(solver, solution.multipliers, tolerance)
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


CHOICES = {"problems": list(PROBLEMS)}


def run(problems=tuple(PROBLEMS), rtol=(1e-4, 1e-8)):
    """Solve each problem by each method, with each preconditioner, to each tolerance."""
    for name in problems:
        problem = PROBLEMS[name](False)  # owns the communicator of its torn system
        for tolerance, preconditioner in itertools.product(rtol, PRECONDITIONERS):
            for entry in measure(name, problem.system, preconditioner, tolerance):
                yield {"problem": name, **entry}
