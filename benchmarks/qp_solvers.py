"""The `qp` layer alone beside general QP solvers: time and accuracy.

    python benchmarks/run.py qp_solvers [--sizes 200 1000] [--grids 50 100 200]

- membranes: the dual of a contact problem of membranes (tests/data), dense, with equalities and
  bounds, singular;
- random n: dense, of condition 1e4, with bounds on 60 % and n / 50 orthonormal equalities;
- obstacle n: a membrane above an obstacle, n^2 unknowns with bounds, a sparse matrix.

The general solvers get the matrices, dense or sparse, and the tolerance 1e-8 in their own scales;
SMALBE-M and MPRGP get the products with them and rtol = 1e-8. The error is that of x in the energy
norm, relative to the solution, which is computed by PIQP with the tolerance 1e-12; the violation is
the largest of bounds and equalities relative to the largest component of the solution. Seconds
are the best of three runs, with set-up, without imports.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import clarabel
import numpy as np
import osqp
import piqp
import qp_problems
import scipy.sparse as sp

from fenics_tfeti.qp import (
    Bounds,
    Products,
    ProductSet,
    ProportioningOptions,
    SMALBEOptions,
    SMALBEState,
    lanczos_estimate,
    proportioning,
    smalbe,
)

TOLERANCE, REFERENCE = 1e-8, 1e-12
LANCZOS_STEPS = 15


@dataclass(frozen=True)
class Problem:
    """min 1/2 x'Ax - b'x subject to Gx = o and x >= lower (-inf: no bound)."""

    name: str
    A: np.ndarray | sp.csc_matrix
    b: np.ndarray
    lower: np.ndarray
    G: np.ndarray

    @property
    def sparse(self) -> bool:
        """Whether A is a sparse matrix."""
        return sp.issparse(self.A)


@dataclass(frozen=True)
class Row:
    """A row of the table; products are those with A."""

    problem: str
    solver: str
    seconds: float
    error: float
    violation: float
    iterations: int


def membranes() -> Problem:
    """Return the dual of the membranes."""
    data = qp_problems.membranes()
    return Problem("membranes", data.A, data.b, data.lower, data.G)


def random(n: int) -> Problem:
    """Return a dense random problem."""
    data = qp_problems.random_problem(0, n, condition=1e4, equalities=n // 50)
    return Problem(f"random {n}", data.A, data.b, data.lower, data.G)


def obstacle(n: int) -> Problem:
    """Return a membrane on the unit square under a load, above two bumps; linear elements."""
    D = sp.diags([np.full(n, 2.0), -np.ones(n - 1), -np.ones(n - 1)], [0, 1, -1])
    A = sp.csc_matrix(sp.kron(D, sp.identity(n)) + sp.kron(sp.identity(n), D))
    x, y = np.meshgrid(*2 * [np.arange(1, n + 1) / (n + 1)], indexing="ij")
    bumps = 0.3 * np.sin(3 * np.pi * x) * np.sin(np.pi * y) - 0.35
    load = np.full(n * n, -10.0 / (n + 1) ** 2)
    return Problem(f"obstacle {n}", A, load, bumps.ravel(), np.zeros((0, n * n)))


def by_mprgp(problem: Problem, tolerance: float) -> tuple[np.ndarray, int]:
    """Solve by SMALBE-M, or by MPRGP alone where there are no equalities."""
    A, b, G = problem.A, problem.b, problem.G
    products, feasible = Products(), ProductSet(Bounds.from_vector(problem.lower))
    start = np.random.default_rng(0).standard_normal(b.size)
    norm = lanczos_estimate(lambda x: A @ x, start, LANCZOS_STEPS)
    inner = ProportioningOptions(
        step_length=1.9 / norm, expansion="projected_cg", max_products=10**6
    )
    if not len(G):
        limit = tolerance * np.linalg.norm(b)
        found = proportioning(
            lambda x: (A @ x, None),
            b,
            feasible,
            np.zeros_like(b),
            lambda split: split.gradient_norm <= limit,
            options=inner,
            products=products,
        )
        return found.x, products.total + LANCZOS_STEPS

    def projected(x: np.ndarray) -> np.ndarray:
        return x - G.T @ (G @ x)

    def augmented(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        Qx = G.T @ (G @ x)
        return projected(A @ (x - Qx)) + norm * Qx, Qx

    zeros = np.zeros_like(b)
    result = smalbe(
        augmented,
        projected(b),
        feasible,
        SMALBEState(zeros, zeros),
        options=SMALBEOptions(rtol=tolerance, rho=norm, max_it=1000, patience=1000, inner=inner),
        products=products,
    )
    return result.state.x, products.total + LANCZOS_STEPS


def by_piqp(problem: Problem, tolerance: float) -> tuple[np.ndarray, int]:
    """Solve by the proximal interior point method."""
    solver = piqp.SparseSolver() if problem.sparse else piqp.DenseSolver()
    settings = solver.settings
    settings.eps_abs = settings.eps_rel = tolerance
    settings.eps_duality_gap_abs = settings.eps_duality_gap_rel = tolerance
    G = sp.csc_matrix(problem.G) if problem.sparse else np.asfortranarray(problem.G)
    A = problem.A if problem.sparse else np.asfortranarray(problem.A)
    solver.setup(A, -problem.b, G, np.zeros(len(problem.G)), x_l=problem.lower)
    solver.solve()
    return np.array(solver.result.x), solver.result.info.iter


def by_osqp(problem: Problem, tolerance: float) -> tuple[np.ndarray, int]:
    """Solve by operator splitting (ADMM), with polishing."""
    rows, low, high = _rows(problem)
    solver = osqp.OSQP()
    solver.setup(
        sp.triu(problem.A, format="csc"),
        -problem.b,
        rows,
        low,
        high,
        eps_abs=tolerance,
        eps_rel=tolerance,
        max_iter=100_000,
        polishing=True,
        verbose=False,
    )
    result = solver.solve(raise_error=True)
    return result.x, result.info.iter


def by_clarabel(problem: Problem, tolerance: float) -> tuple[np.ndarray, int]:
    """Solve by the interior point method of Clarabel."""
    rows, low, _ = _rows(problem)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = tolerance
    equalities = len(problem.G)
    cones = [clarabel.ZeroConeT(equalities), clarabel.NonnegativeConeT(len(low) - equalities)]
    result = clarabel.DefaultSolver(
        sp.triu(problem.A, format="csc"), -problem.b, -rows, -low, cones, settings
    ).solve()
    return np.array(result.x), result.iterations


def _rows(problem: Problem) -> tuple[sp.csc_matrix, np.ndarray, np.ndarray]:
    """Return low <= rows x <= high: the equalities, then the bounds."""
    bounded = np.flatnonzero(problem.lower > -np.inf)
    identity = sp.identity(problem.b.size, format="csr")[bounded]
    rows = sp.vstack([sp.csr_matrix(problem.G), identity], format="csc")
    low = np.concatenate([np.zeros(len(problem.G)), problem.lower[bounded]])
    return rows, low, np.where(np.arange(low.size) < len(problem.G), 0.0, np.inf)


Method = Callable[[Problem, float], tuple[np.ndarray, int]]
SOLVERS: dict[str, Method] = {
    "fenics_tfeti.qp": by_mprgp,
    "PIQP": by_piqp,
    "OSQP": by_osqp,
    "Clarabel": by_clarabel,
}


def compare(problem: Problem, runs: int = 3) -> list[Row]:
    """Return a row for each solver."""
    exact = by_piqp(problem, REFERENCE)[0]
    energy = float(exact @ (problem.A @ exact))
    table = []
    for name, solve in SOLVERS.items():
        seconds = []
        for _ in range(runs):
            begin = time.perf_counter()
            x, iterations = solve(problem, TOLERANCE)
            seconds.append(time.perf_counter() - begin)
        difference = x - exact
        error = np.sqrt(max(0.0, float(difference @ (problem.A @ difference))) / energy)
        below = np.maximum(problem.lower - x, 0.0).max()
        violation = max(below, np.abs(problem.G @ x).max(initial=0.0)) / np.abs(exact).max()
        table.append(Row(problem.name, name, min(seconds), float(error), violation, iterations))
    return table


def run(sizes=(200, 1000), grids=(50, 100, 200)):
    """Solve all problems by all solvers."""
    for problem in [membranes(), *map(random, sizes), *map(obstacle, grids)]:
        for row in compare(problem):
            yield asdict(row)
