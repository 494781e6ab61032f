"""Quadratic programmes with known solutions, and an independent solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import quadprog
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.qp import Bounds

DATA = Path(__file__).parent.parent / "data"
Vector = NDArray[np.float64]


@dataclass
class Problem:
    """min 1/2 x'Ax - b'x subject to Gx = o and x >= lower (-inf: no bound)."""

    A: Vector
    b: Vector
    lower: Vector
    G: Vector = field(default_factory=lambda: np.zeros((0, 0)))
    calls: int = 0

    def __post_init__(self) -> None:
        self.G = self.G.reshape(-1, self.b.size)

    @property
    def bounds(self) -> Bounds:
        return Bounds.from_vector(self.lower)

    @property
    def norm(self) -> float:
        return float(scipy.linalg.eigh(self.A, eigvals_only=True)[-1])

    def hessian(self, x: Vector) -> tuple[Vector, None]:
        """Return Ax, counted."""
        self.calls += 1
        return self.A @ x, None

    def penalised(self, rho: float) -> Callable[[Vector], tuple[Vector, Vector]]:
        """Return x -> ((A + rho G'G) x, G'Gx), counted."""

        def apply(x: Vector) -> tuple[Vector, Vector]:
            self.calls += 1
            Qx = self.G.T @ (self.G @ x)
            return self.A @ x + rho * Qx, Qx

        return apply

    def cost(self, x: Vector) -> float:
        return float(0.5 * x @ (self.A @ x) - self.b @ x)

    def projected_gradient(self, x: Vector, g: Vector) -> Vector:
        """Return the projected gradient by its definition, component by component."""
        return np.array(
            [min(gi, 0.0) if xi == li else gi for xi, li, gi in zip(x, self.lower, g, strict=True)]
        )

    def solution(self) -> Vector:
        """Solve by Goldfarb and Idnani's dual active set method (quadprog)."""
        bounded = np.flatnonzero(np.isfinite(self.lower))
        rows = np.vstack([self.G, np.eye(self.b.size)[bounded]])
        right = np.concatenate([np.zeros(len(self.G)), self.lower[bounded]])
        # G'G changes nothing where Gx = o, but makes a Hessian definite that is so only there.
        scale = np.abs(self.A).max()
        hessian = self.A / scale + self.G.T @ self.G
        constraints = (rows.T, right, len(self.G)) if len(rows) else ()
        return quadprog.solve_qp(hessian, self.b / scale, *constraints)[0]


def random_problem(
    seed: int, n: int = 20, bounded: float = 0.6, condition: float = 1e2, equalities: int = 0
) -> Problem:
    """Return a dense random problem; G has orthonormal rows, and x = o is feasible."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = (basis * np.geomspace(1.0, 1.0 / condition, n)) @ basis.T
    lower = np.where(rng.random(n) < bounded, -rng.random(n), -np.inf)
    G = np.linalg.qr(rng.standard_normal((n, equalities)))[0].T
    return Problem(0.5 * (A + A.T), rng.standard_normal(n), lower, G)


def string(n: int = 32, height: float = -1.0 / 32.0) -> tuple[Problem, Vector, Vector]:
    """-u'' = -1 on (0, 1), u(0) = u(1) = 0, u >= height, by n linear elements.

    Returns the problem in the inner nodes, the nodes and the exact values there: with height
    -1/32 the string rests on [1/4, 3/4] and leaves the obstacle with slope zero.
    """
    A = n * (2.0 * np.eye(n - 1) - np.eye(n - 1, k=1) - np.eye(n - 1, k=-1))
    x = np.linspace(0.0, 1.0, n + 1)[1:-1]
    s = np.minimum(np.minimum(x, 1.0 - x), 0.25)
    problem = Problem(A, np.full(n - 1, -1.0 / n), np.full(n - 1, height))
    return problem, x, 0.5 * s**2 - 0.25 * s


def membranes() -> Problem:
    """Return the dual of a contact problem of membranes, computed by another code."""
    data = np.load(DATA / "membranes.npz")

    def matrix(name: str, rows: int) -> NDArray[np.float64]:
        csr = data[f"{name}_data"], data[f"{name}_indices"], data[f"{name}_indptr"]
        return sp.csr_matrix(csr, shape=(rows, data["b"].size)).toarray()

    upper = matrix("F_upper", data["b"].size)
    F = upper + np.triu(upper, 1).T
    return Problem(F, data["b"], data["c"], matrix("G", data["G_indptr"].size - 1))
