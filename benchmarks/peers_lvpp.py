"""Half a ball pressed on rigid ground, by fenics_tfeti and by LVPP (proximal Galerkin) in dolfinx.

    OMP_NUM_THREADS=1 python benchmarks/run.py peers_lvpp --divisions 4 6 8 --degrees 1

Body, indentation, step lengths and tolerances are those of the Signorini problem in "The latent
variable proximal point algorithm for variational problems with constraints" (Dokken, Farrell,
Keith, Papadopoulos, Surowiec 2025); the mesh is another one, of hexahedra. Needs dolfinx 0.10.
"""

from __future__ import annotations

import time
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scenes import Scene, at, elasticity, plane

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import NonlinearProblem
from dolfinx.mesh import create_submesh

RADIUS, HEIGHT, YOUNG = 0.4, 0.5, 2e4
INDENTATION, LOWERED = 0.05, 0.15
BOTTOM, TOP = 1, 2
# LVPP: length of the k-th step FIRST_STEP 2^k, for a residual without units
FIRST_STEP, MOST_STEPS, TOLERANCE = 0.005, 25, 1e-6
LINEAR_SOLVER = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


def run(divisions=(4,), degrees=(1, 2)):
    """Solve by both on each mesh, first on a small one, which compiles the forms."""
    for degree in degrees:
        for solve in (solve_by_tfeti, solve_by_lvpp):
            solve(half_ball(1, degree))
        for n in divisions:
            start = time.process_time()
            u, force, products = solve_by_tfeti(ball := half_ball(n, degree))
            middle = time.process_time()
            v, other_force, newton = solve_by_lvpp(other := half_ball(n, degree))
            end = time.process_time()
            yield {
                "degree": degree,
                "unknowns": len(u.x.array),
                "products": products,
                "steps": len(newton),
                "newton": sum(newton),
                "ratio": (end - middle) / (middle - start),
                "penetration": penetration(ball, u),
                "lvpp_penetration": penetration(other, v),
                "force": force,
                "force_difference": other_force / force - 1,
                "difference": np.linalg.norm(v.x.array - u.x.array) / np.linalg.norm(u.x.array),
            }


def half_ball(n: int, degree: int) -> Scene:
    """Return the lower half of a ball, lowered by its flat face, with 2n x 2n x n elements."""
    part = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.0), (2 * n, 2 * n, n))
    marks = [(BOTTOM, at(2, -1.0)), (TOP, at(2, 0.0))]
    ball = Scene.of_boxes(
        MPI.COMM_SELF, "hexahedron", [part], marks, _cube_to_ball, degree=degree, young=YOUNG
    )
    for component, value in enumerate((0.0, 0.0, -LOWERED)):
        ball.fix(TOP, component, value)
    return ball


def _cube_to_ball(x: NDArray[np.float64]) -> NDArray[np.float64]:
    s, t = np.roll(x, -1, axis=0) ** 2, np.roll(x, -2, axis=0) ** 2
    return RADIUS * x * np.sqrt(1 - s / 2 - t / 2 + s * t / 3) + [[0.0], [0.0], [HEIGHT]]


def solve_by_tfeti(ball: Scene) -> tuple[Any, float, int]:
    """Return displacement, contact force, and products with F."""
    ball.add_obstacle(BOTTOM, plane(2, 3))
    problem = ball.problem(cell_tags=None)
    u = problem.solve()
    force = float(problem.results[0].nodal_normal_force.sum())
    return u, force, problem.report.products["total"]


def solve_by_lvpp(ball: Scene) -> tuple[Any, float, list[int]]:
    """Return displacement, contact force, and the Newton steps of each proximal step.

    The gap is the exponential of a latent variable on the surface; its change in a proximal step is
    minus the pressure times the length of the step.
    """
    surface, surface_to_mesh = create_submesh(ball.mesh, 2, ball.facet_tags.find(BOTTOM))[:2]
    latent_space = fem.functionspace(surface, ("Lagrange", ball.V.element.basix_element.degree))
    u, latent, last = fem.Function(ball.V), fem.Function(latent_space), fem.Function(latent_space)
    v, w = ufl.TestFunctions(ufl.MixedFunctionSpace(ball.V, latent_space))
    length = fem.Constant(ball.mesh, FIRST_STEP)
    ds = ball.ds(BOTTOM, degree=4)
    residual = length * elasticity(u, v, ball.young) + (latent - last) * v[2] * ds
    residual += (_gap(ball, u) - ufl.exp(latent)) * w * ds
    problem = NonlinearProblem(
        ufl.extract_blocks(residual),
        [u, latent],
        bcs=ball.bcs,
        entity_maps=[surface_to_mesh],
        petsc_options_prefix="lvpp_",
        petsc_options={
            "snes_linesearch_type": "none",
            "snes_error_if_not_converged": True,
            "snes_atol": TOLERANCE,
            "snes_rtol": TOLERANCE,
            **LINEAR_SOLVER,
        },
    )
    newton: list[int] = []
    for k in range(1, MOST_STEPS + 1):
        length.value = FIRST_STEP * 2**k
        before = u.x.array.copy()
        problem.solve()
        newton.append(problem.solver.getIterationNumber())
        if np.linalg.norm(u.x.array - before) <= TOLERANCE:
            pressure = (last - latent) / length
            form = fem.form(pressure * ds, entity_maps=[surface_to_mesh])
            return u, fem.assemble_scalar(form), newton
        last.x.array[:] = latent.x.array
    raise RuntimeError(f"LVPP did not converge in {MOST_STEPS} steps")


def penetration(ball: Scene, u: Any) -> float:
    """Return the root mean square of the penetration, relative to the indentation."""
    gap, ds = _gap(ball, u), ball.ds(BOTTOM, degree=4)
    square, area = (fem.form(f * ds) for f in (ufl.min_value(gap, 0.0) ** 2, 1 + 0 * gap))
    return float(np.sqrt(fem.assemble_scalar(square) / fem.assemble_scalar(area)) / INDENTATION)


def _gap(ball: Scene, u: Any) -> Any:
    return ufl.SpatialCoordinate(ball.mesh)[2] + u[2]
