"""Quadratic programmes with known solutions, and independent solvers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import quadprog
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.qp import Bounds, Discs, ProductSet

DATA = Path(__file__).parent.parent / "data"
Vector = NDArray[np.float64]
NO_DISCS = Discs(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2)), np.zeros(0))


@dataclass
class Problem:
    """min 1/2 x'Ax - b'x subject to Gx = o, lower <= x <= upper (infinite: no bound) and discs."""

    A: Vector
    b: Vector
    lower: Vector
    G: Vector = field(default_factory=lambda: np.zeros((0, 0)))
    upper: Vector = field(default_factory=lambda: np.full(1, np.inf))
    discs: Discs = NO_DISCS
    calls: int = 0

    def __post_init__(self) -> None:
        self.G = self.G.reshape(-1, self.b.size)
        self.upper = np.broadcast_to(self.upper, self.lower.shape)

    @property
    def bounds(self) -> Bounds:
        return Bounds.from_vector(self.lower, self.upper)

    @property
    def feasible(self) -> ProductSet:
        """The bounds, with the discs where there are some."""
        return ProductSet(self.bounds, self.discs if self.discs.radius.size else None)

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
            [
                0.0 if (xi == li and gi > 0.0) or (xi == ui and gi < 0.0) else gi
                for xi, li, ui, gi in zip(x, self.lower, self.upper, g, strict=True)
            ]
        )

    def nearest(self, x: Vector) -> Vector:
        """Project on bounds and discs by their definitions, block by block."""
        y = np.clip(x, self.lower, self.upper)
        for at, centre, radius in zip(
            self.discs.indices, self.discs.centre, self.discs.radius, strict=True
        ):
            away = x[at] - centre
            y[at] = centre + away * min(1.0, radius / np.hypot(*away)) if away.any() else centre
        return y

    def contains(self, x: Vector) -> bool:
        """Return whether x is within the bounds exactly, and up to rounding in the discs."""
        d = self.discs
        outside = np.linalg.norm(x[d.indices] - d.centre, axis=1) > d.radius * (1.0 + 1e-14)
        return bool(np.all((self.lower <= x) & (x <= self.upper)) and not outside.any())

    def stationarity(self, x: Vector, g: Vector) -> float:
        """Return the norm of (x - P(x - a g)) / a, which vanishes at minima alone if g is Ax - b.

        Without discs it is that of the projected gradient.
        """
        if not self.discs.radius.size:
            return float(np.linalg.norm(self.projected_gradient(x, g)))
        step_length = 1.9 / self.norm
        return float(np.linalg.norm(x - self.nearest(x - step_length * g)) / step_length)

    def solution(self) -> Vector:
        """Solve by Goldfarb and Idnani's dual active set method (quadprog), without discs."""
        assert self.discs.radius.size == 0
        fixed, given = self.equality_rows()
        rows, right = self.inequality_rows()
        rows, right = np.vstack([fixed, rows]), np.append(given, right)
        # G'G changes nothing where Gx = o, but makes a Hessian definite that is so only there.
        scale = np.abs(self.A).max()
        hessian = self.A / scale + self.G.T @ self.G
        constraints = (rows.T, right, len(fixed)) if len(rows) else ()
        return quadprog.solve_qp(hessian, self.b / scale, *constraints)[0]

    def equality_rows(self) -> tuple[Vector, Vector]:
        """Return Gx = o and intervals of size 0 as rows @ x = right."""
        fixed = self.lower == self.upper
        rows = np.vstack([self.G, np.eye(self.b.size)[fixed]])
        return rows, np.append(np.zeros(len(self.G)), self.lower[fixed])

    def inequality_rows(self) -> tuple[Vector, Vector]:
        """Return rows and right-hand sides of the other bounds as rows @ x >= right."""
        unit, (below, above) = np.eye(self.b.size), self.half_lines()
        rows = np.vstack([unit[below], -unit[above]])
        return rows, np.concatenate([self.lower[below], -self.upper[above]])

    def half_lines(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the components with a lower and those with an upper bound, fixed ones apart."""
        open_ = self.lower < self.upper
        return tuple(
            np.flatnonzero(np.isfinite(bound) & open_) for bound in (self.lower, self.upper)
        )

    def independence(self, x: Vector) -> float:
        """Return the smallest singular value of G on the directions that are free at x.

        The multipliers of SMALBE-M converge with a factor of 1 / (1 + rho s^2 / ||A||) at worst.
        """
        rounding = 1e-8 * max(1.0, np.abs(x).max())
        free = (x > self.lower + rounding) & (x < self.upper - rounding)
        tangential = []
        for at, centre, radius in zip(
            self.discs.indices, self.discs.centre, self.discs.radius, strict=True
        ):
            offset = x[at] - centre
            if np.hypot(*offset) >= radius - rounding:
                free[at] = False
                if radius > 0.0:
                    tangential.append(self.G[:, at] @ np.array([-offset[1], offset[0]]) / radius)
        rows = np.column_stack([self.G[:, free], *tangential])
        if rows.shape[1] < rows.shape[0]:
            return 0.0
        return float(np.linalg.svd(rows, compute_uv=False)[-1])


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


def random_intervals(seed: int, n: int = 20, condition: float = 1e2, **more: int) -> Problem:
    """Return a random problem with lines, half-lines on both sides, and intervals, also of size 0.

    x = o is feasible.
    """
    problem, rng = random_problem(seed, n, 0.6, condition, **more), np.random.default_rng(seed + 1)
    problem.upper = np.where(rng.random(n) < 0.6, 0.5 * rng.random(n), np.inf)
    problem.lower[:2] = problem.upper[:2] = 0.0
    return problem


def random_discs(
    seed: int, discs: int = 6, condition: float = 1e2, size: float = 1.0, **more: int
) -> Problem:
    """Return a random problem with discs of radii up to `size`, one of them zero, and bounds.

    x = o is feasible. The discs take the last components, each its two far apart.
    """
    rng = np.random.default_rng(seed + 1)
    problem = random_problem(seed, 4 * discs, 0.5, condition, **more)
    at = np.arange(2 * discs, 4 * discs).reshape(2, discs).T
    problem.lower[at] = -np.inf
    radius = size * rng.random(discs)
    radius[0] = 0.0
    direction = rng.standard_normal((discs, 2))
    away = 0.9 * radius * rng.random(discs) / np.linalg.norm(direction, axis=1)
    problem.discs = Discs(at, away[:, None] * direction, radius)
    return problem


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
