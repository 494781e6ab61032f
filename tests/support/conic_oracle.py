"""Quadratic programmes with discs: an interior point method, polished to rounding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

if TYPE_CHECKING:
    from qp_problems import Problem

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]
ROUNDING = 1e-11


@dataclass(frozen=True)
class ConicSolution:
    """A solution, and the largest violation of its KKT conditions relative to its size."""

    x: Vector
    violation: float

    @property
    def accurate(self) -> bool:
        """Tell whether the KKT conditions, which are sufficient, hold to rounding."""
        return self.violation <= ROUNDING


@dataclass(frozen=True)
class ActiveSet:
    """What the solution does not leave free: components at bounds, and discs at their circle."""

    lower: Mask
    upper: Mask
    discs: Mask


def conic_solution(problem: Problem) -> ConicSolution:
    """Solve with second-order cones, then the equations of the active set by Newton's method.

    The interior point method alone is accurate to 1e-6, or to 1e-4 where it stops before its
    tolerance, which depends on its version. After the polish the KKT conditions hold to rounding,
    but for one of some thousand random problems, whose active set is not found.
    """
    x, active = _interior_point(problem)
    x, y, nu = _polish(problem, x, active)
    return ConicSolution(x, _violation(problem, active, x, y, nu))


def _interior_point(problem: Problem) -> tuple[Vector, ActiveSet]:
    """Return an approximate solution, and where multipliers are larger than slacks."""
    fixed, given = problem.equality_rows()
    rows, right = problem.inequality_rows()
    n, discs = problem.b.size, problem.discs
    # A x + s = b with s in the cones: zero, nonnegative, and (r, x - centre) for each disc
    blocks = [np.vstack([np.zeros(n), -np.eye(n)[at]]) for at in discs.indices]
    parts = [np.append(r, -c) for c, r in zip(discs.centre, discs.radius, strict=True)]
    cones = [clarabel.ZeroConeT(len(fixed)), clarabel.NonnegativeConeT(len(rows))]
    cones += [clarabel.SecondOrderConeT(3)] * len(blocks)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    scale = np.abs(problem.A).max()
    solution = clarabel.DefaultSolver(
        # G'G changes nothing where Gx = o
        sp.csc_matrix(np.triu(problem.A / scale + problem.G.T @ problem.G)),
        -problem.b / scale,
        sp.csc_matrix(np.vstack([fixed, -rows, *blocks])),
        np.concatenate([given, -right, *parts]),
        cones,
        settings,
    ).solve()
    slack, multiplier = np.array(solution.s), np.array(solution.z)
    first, last = len(fixed), len(fixed) + len(rows)
    pressing = multiplier[first:last] > slack[first:last]
    below, above = problem.half_lines()
    lower, upper = problem.lower == problem.upper, np.zeros(n, dtype=bool)
    lower[below], upper[above] = pressing[: below.size], pressing[below.size :]
    s, z = slack[last:].reshape(-1, 3), multiplier[last:].reshape(-1, 3)
    distance = s[:, 0] - np.linalg.norm(s[:, 1:], axis=1)
    at_circle = distance < np.linalg.norm(z, axis=1)
    return np.array(solution.x), ActiveSet(lower, upper, at_circle)


def _polish(problem: Problem, x: Vector, active: ActiveSet) -> tuple[Vector, Vector, Vector]:
    """Solve the KKT equations of an active set by Newton's method.

    Returns x and the multipliers of Gx = o and of the active discs.
    """
    x = np.where(active.lower, problem.lower, np.where(active.upper, problem.upper, x))
    free = ~(active.lower | active.upper)
    points = active.discs & (problem.discs.radius == 0.0)
    x[problem.discs.indices[points]] = problem.discs.centre[points]
    free[problem.discs.indices[points]] = False
    count = np.count_nonzero(free)
    equalities = len(problem.G)
    y, nu = np.zeros(equalities), np.zeros(np.count_nonzero(active.discs))
    for newton in range(20):
        gradient, curvature, normals, circles = _lagrangian(problem, active, x, y, nu)
        rows = np.vstack([problem.G, normals])[:, free]
        hessian = (problem.A + np.diag(curvature))[np.ix_(free, free)]
        zeros = np.zeros((len(rows), len(rows)))
        matrix = np.block([[hessian, rows.T], [rows, zeros]])
        residual = np.concatenate([gradient[free], problem.G @ x, circles])
        if newton == 0:  # multipliers alone: the curvature of the discs depends on them
            matrix, residual = matrix[:count, count:], residual[:count]
        step = np.zeros(count + len(rows))
        step[-matrix.shape[1] :] = np.linalg.lstsq(matrix, -residual, rcond=None)[0]
        x[free] += step[:count]
        y, nu = y + step[count : count + equalities], nu + step[count + equalities :]
    return x, y, nu


def _lagrangian(
    problem: Problem, active: ActiveSet, x: Vector, y: Vector, nu: Vector
) -> tuple[Vector, Vector, NDArray[np.float64], Vector]:
    """Return its gradient, the discs' share of its second derivative, their normals and gaps."""
    discs = problem.discs
    at, radius = discs.indices[active.discs], discs.radius[active.discs]
    offset = x[at] - discs.centre[active.discs]
    size = np.where(radius > 0.0, radius, 1.0)  # a disc that is a point has no normal
    normals = np.zeros((len(at), x.size))
    np.put_along_axis(normals, at, offset / size[:, None], axis=1)
    curvature = np.zeros(x.size)
    curvature[at] = (nu / size)[:, None]
    gradient = problem.A @ x - problem.b + problem.G.T @ y + normals.T @ nu
    return gradient, curvature, normals, 0.5 * (np.sum(offset**2, axis=1) / size - radius)


def _violation(problem: Problem, active: ActiveSet, x: Vector, y: Vector, nu: Vector) -> float:
    """Return the largest violation of the KKT conditions, in units of the data."""
    discs = problem.discs
    gradient, _, _, circles = _lagrangian(problem, active, x, y, nu)
    free = ~(active.lower | active.upper)
    free[discs.indices[active.discs & (discs.radius == 0.0)]] = False
    forces = [
        np.abs(gradient[free]),
        -gradient[active.lower & (problem.lower < problem.upper)],
        gradient[active.upper],
        -nu,
    ]
    lengths = [
        np.abs(problem.G @ x),
        np.abs(circles),
        problem.lower - x,
        x - problem.upper,
        np.linalg.norm(x[discs.indices] - discs.centre, axis=1) - discs.radius,
    ]
    length = np.abs(x).max(initial=1e-300)
    force = np.abs(problem.A).max() * length + np.abs(problem.b).max()
    return max(
        *(part.max(initial=0.0) / force for part in forces),
        *(part.max(initial=0.0) / length for part in lengths),
    )
