"""The bound of the certificate against the true error in the energy norm, and the products spent.

    python benchmarks/run.py accuracy [--problems beams stack] [--rtol 1e-2 1e-6]

The problems of `products.py`, the first rung of the ladder (`beams.py`, 108 cubes of 8^3 elements)
and two beams of unstructured tetrahedra (`general.py`, 12 elements per metre), on one rank. The
true error is that of the displacement which is returned, relative to the solution at rtol 1e-9.

Needs Gmsh with its Python module.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import beams
import general
import numpy as np
import products

from fenics_tfeti import ContactProblem
from fenics_tfeti.io import read_msh


def ladder() -> ContactProblem:
    """Return the two beams in cubes of 1/3 m."""
    return beams.build(3, 8, 1e-6)


def tetrahedra() -> ContactProblem:
    """Return the two beams of unstructured tetrahedra in the default subdomains."""
    with tempfile.TemporaryDirectory() as folder:
        paths = general.make_meshes(12, Path(folder))
        return general.Beams(read_msh(paths["contact"])).contact()


PROBLEMS: dict[str, Callable[[], ContactProblem]] = {
    **{name: lambda build=build: build(False) for name, build in products.PROBLEMS.items()},
    "ladder": ladder,
    "tetrahedra": tetrahedra,
}


def with_options(name: str, **options) -> ContactProblem:
    """Return a new problem with some options of the solver."""
    problem = PROBLEMS[name]()
    solver = replace(problem.options.solver, **options)
    problem.options = replace(problem.options, solver=solver)
    return problem


def energy_norm(problem: ContactProblem, u: np.ndarray) -> float:
    """Return ||u||_K of a displacement on all nodes."""
    by_node = u.reshape(-1, problem.space.mesh.geometry.dim)
    parts = ((by_node[s.nodes].ravel(), s.stiffness) for s in problem.system.subdomains)
    return float(np.sqrt(sum(v @ (K @ v) for v, K in parts)))


def measure(name: str, exact: np.ndarray, preconditioner: str, rtol: float) -> dict[str, object]:
    """Solve a problem; return products, the true error and the certificate."""
    problem = with_options(name, rtol=rtol, preconditioner=preconditioner)
    u = problem.solve().x.array
    report = problem.report
    true = energy_norm(problem, u - exact) / energy_norm(problem, exact)
    return {
        "problem": name,
        "preconditioner": preconditioner,
        "rtol": rtol,
        "products": report.products["total"],
        "applications": report.products["preconditioner"],
        "true": true,
        "bound": report.certificate.error,
        "bound / true": report.certificate.error / true,
        "largest": report.certificate.worst,
    }


CHOICES = {"problems": list(PROBLEMS)}


def run(problems=tuple(PROBLEMS), rtol=(1e-2, 1e-4, 1e-6, 1e-8)):
    """Solve each problem with both preconditioners to each tolerance."""
    for name in problems:
        exact = with_options(name, rtol=1e-9).solve().x.array.copy()
        for preconditioner in ("lumped", "dirichlet"):
            for tolerance in rtol:
                yield measure(name, exact, preconditioner, tolerance)
