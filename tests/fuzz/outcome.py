"""Solve a case with the package, and compare with what the oracle says."""

from __future__ import annotations

import traceback
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np
from glued import GluedProblem, rigid_modes
from numpy.typing import NDArray
from oracle import Answer

from fenics_tfeti.errors import (
    ContactError,
    FactorizationError,
    InputError,
    NotConverged,
    UnresistedMotion,
)

Vector = NDArray[np.float64]

# classes of outcomes
FINE = ("right", "right error", "limit of rounding", "skipped", "no contraction")
FAILURES = ("wrong", "no convergence", "false error", "traceback", "hang", "ranks differ")
CLASSES = FINE + FAILURES

# the error in the energy norm that counts as right, relative to rtol
FACTOR = 10.0
# a body whose energy norm is below this part of its group's is compared with the group's, and
# below this part of all bodies' with theirs; a body below AT_REST of all does not deform, and its
# error may be that large
OF_GROUP, OF_ALL, AT_REST = 1e-3, 1e-6, 1e-8
# rounding errors of the package are this much larger than those of one operation on the data
ROUNDINGS = 1e2
# part of the energy norms of motions and loads below which strains count as none: ten times that of
# the package, whose norms are others
_EPS = 2.0**-52
UNDEFORMED = 1e6 * _EPS


@dataclass(frozen=True)
class Found:
    """What the package returned, in the unknowns of the glued problem."""

    displacement: Vector | None = None  # (n,), the mean of copies
    jump: Vector = field(default_factory=lambda: np.zeros(0))  # (nodes,), between copies
    force: Vector = field(default_factory=lambda: np.zeros(0))  # (m,), by contact row
    tied: Vector = field(default_factory=lambda: np.zeros(0))  # (t,), by tied row
    tangential: Vector = field(default_factory=lambda: np.zeros((0, 1)))  # (k, gdim - 1), by site
    # as reported: sums of normal forces, energy, products
    contact_force: list[float] = field(default_factory=list)
    energy: float = 0.0
    products: int = 0
    error: Exception | None = None  # what was raised, perhaps beside an iterate
    trace: str = ""

    @property
    def said(self) -> str:
        """The error in words; nothing without one."""
        return "" if self.error is None else f"{type(self.error).__name__}: {self.error}"


@dataclass(frozen=True)
class Outcome:
    """The class of an outcome, and what it rests on."""

    kind: str
    detail: str = ""
    numbers: dict[str, float] = field(default_factory=dict)


def attempt(solve: Any) -> Found:
    """Run a function that returns `Found`; errors become part of it."""
    try:
        found: Found = solve()
        return found
    except Exception as error:
        return Found(error=error, trace=traceback.format_exc())


def compare(problem: GluedProblem, answer: Answer, found: Found, rtol: float) -> Outcome:
    """Return the class of an outcome."""
    other = without_solution(answer, found)
    if other is not None:
        return other
    error, said = found.error, found.said
    if isinstance(error, NotConverged):
        needs = _attainable(answer)
        if rtol < needs < np.inf:
            return Outcome("limit of rounding", f"{said}; rounding alone makes {needs:.1e}")
        return Outcome("no convergence", said)
    if isinstance(error, UnresistedMotion) and 1.0 < _attainable(answer) < np.inf:
        # what resists the motion is a rounding error of the data
        return Outcome(
            "limit of rounding", f"{said}; rounding alone makes {_attainable(answer):.1e}"
        )
    if error is not None:
        return Outcome("false error", said)
    return _compare_solution(problem, answer, found, rtol)


def compare_refused(found: Found) -> Outcome:
    """Return the class of the outcome for data that are wrong on purpose."""
    error = found.error
    if error is None:
        return Outcome("wrong", "a system with a mistake was accepted")
    said = f"{type(error).__name__}: {error}"
    if not isinstance(error, ContactError):
        return Outcome("traceback", f"{said}\n{found.trace}")
    refused = isinstance(error, InputError | FactorizationError)
    right = refused and not isinstance(error, UnresistedMotion)
    return Outcome("right error" if right else "false error", said)


def without_solution(answer: Answer, found: Found) -> Outcome | None:
    """Return the class where the package crashed or no solution is known; None otherwise."""
    if found.error is not None and not isinstance(found.error, ContactError):
        return Outcome("traceback", f"{found.said}\n{found.trace}")
    if answer.verdict == "unsure":
        return Outcome("skipped", answer.why)
    if answer.verdict != "solution":
        return _compare_error(answer, found.error, found.said)
    return None


def _compare_error(answer: Answer, error: Exception | None, said: str) -> Outcome:
    what = f"{answer.verdict}: {answer.why}"
    if error is None:
        return Outcome("wrong", f"converged, but {what}")
    if isinstance(error, NotConverged):
        return Outcome("no convergence", f"{said}; {what}")
    is_motion = isinstance(error, UnresistedMotion)
    right = {
        "infeasible": isinstance(error, InputError) and not is_motion,
        "unbounded": is_motion,
        "infeasible and unbounded": isinstance(error, InputError),
    }[answer.verdict]
    return Outcome("right error" if right else "false error", f"{said}; {what}")


def _scales(answer: Answer) -> Vector:
    """Return the energy norm that the error of each body is compared with."""
    energy = answer.energy
    of_all = np.full(energy.size, OF_ALL**2 * energy.sum())
    return np.sqrt(np.maximum.reduce([energy, OF_GROUP**2 * _of_groups(answer, energy), of_all]))


def _attainable(answer: Answer) -> float:
    """Return the relative error that rounding the data alone may make, in the worst body."""
    scale = _scales(answer)
    noise = ROUNDINGS * answer.noise
    return float(np.max(np.divide(noise, scale, out=np.zeros_like(noise), where=scale > 0.0)))


def _compare_solution(problem: GluedProblem, answer: Answer, found: Found, rtol: float) -> Outcome:
    u = found.displacement
    assert u is not None
    if not np.isfinite(u).all():
        return Outcome("wrong", "displacements are not finite")
    rounded_gap = ROUNDINGS * float(problem.gap_rounding.max(initial=0.0))
    if 0.0 < np.abs(answer.displacement).max(initial=0.0) <= rounded_gap:
        largest = np.array([np.abs(u).max()])
        return outcome_of({"displacement by a rounded gap": worst(largest, rounded_gap)})
    scale, floor = _scales(answer), ROUNDINGS * answer.noise
    if np.any(answer.error > 0.3 * FACTOR * rtol * scale + floor):
        own = float(np.max(answer.error / np.maximum(scale, 1e-300)))
        return Outcome("skipped", f"the oracle's own error is {own:.1e}")
    whole = float(np.sqrt(answer.energy.sum()))
    floor = floor + AT_REST * whole * (answer.energy <= (AT_REST * whole) ** 2)
    difference = u - answer.displacement
    errors = np.zeros(problem.bodies)
    size, deformation, rigid = (np.zeros(problem.bodies) for _ in range(3))
    K = (problem.elastic + problem.springs.matrix()).tocsr()
    springs = problem.springs
    np.add.at(
        errors, problem.body_of_springs(), springs.stiffness * (springs.rows @ difference) ** 2
    )
    for b in range(problem.bodies):
        at = problem.unknowns(b)
        part = difference[at] - rigid_part(problem, b, difference[at])
        errors[b] += max(0.0, float(part @ (problem.elastic[at][:, at] @ part)))
        exact = answer.displacement[at]
        size[b] = np.abs(exact).max()
        deformation[b] = np.abs(exact - rigid_part(problem, b, exact)).max()
    motion, load = scale_of_rounding(problem, size.max(), K)
    floor = floor + 1e-15 * motion + 1e-12 * load
    # the package calls strains rounding up to this part of motions and loads
    none, strain = UNDEFORMED * (motion + load), np.sqrt(_of_groups(answer, answer.energy))
    floor = floor + np.where(_is_noise(answer), none, 0.0)
    # and does not look at their errors, which those of motions of other bodies are
    floor = floor + np.where(strain <= none, ROUNDINGS * _EPS * (motion + load), 0.0)
    ratio = {"error": worst(np.sqrt(errors), FACTOR * rtol * scale + floor)}

    # local lengths: of the bodies that a row joins, without their rigid motions
    tolerance = FACTOR * rtol * deformation + rounded_lengths(problem, size, K)
    exact_opening = problem.gap - problem.rows @ answer.displacement
    ratio |= displacement_ratios(problem, found, tolerance, np.minimum(exact_opening, 0.0))
    ratio["forces"] = _force_ratio(problem, answer, found, rtol)
    exact_energy = float(0.5 * answer.energy.sum() - problem.load @ answer.displacement)
    absolute = np.abs(answer.displacement)
    noise = 1e-12 * float(np.abs(problem.load) @ absolute)
    noise += 1e-13 * float(absolute @ abs(K) @ absolute) + (1e-12 * load) ** 2
    ratio["energy"] = worst(
        np.array([abs(found.energy - exact_energy)]),
        np.array([FACTOR * rtol * max(abs(exact_energy), 0.5 * answer.energy.sum()) + noise]),
    )
    return outcome_of(ratio)


def outcome_of(ratio: dict[str, float]) -> Outcome:
    bad = {name: value for name, value in ratio.items() if value > 1.0}
    if not bad:
        return Outcome("right", "", ratio)
    words = ", ".join(f"{name} {value:.1e}" for name, value in bad.items())
    return Outcome("wrong", f"times what is allowed: {words}", ratio)


def scale_of_rounding(problem: GluedProblem, largest: float, K: Any) -> tuple[Vector, float]:
    """Return the energy norms that rounding is relative to.

    They are those of motions by body, and of what the load does to each unknown alone.
    """
    unknowns = map(problem.unknowns, range(problem.bodies))
    stiffness = np.array([abs(K[at][:, at]).max() for at in unknowns])
    return np.sqrt(stiffness) * largest, float(np.sqrt(np.sum(problem.load**2 / K.diagonal())))


def rounded_lengths(problem: GluedProblem, size: Vector, K: Any) -> Vector:
    """Return what rounding makes of displacements whose largest by body are given."""
    reach = float(np.max(np.abs(problem.load) / K.diagonal()))
    rounding: Vector = 1e-12 * size + 1e-14 * size.max() + 1e-12 * reach
    return rounding


def allowed_at_rows(rows: Any, problem: GluedProblem, length: Vector) -> Vector:
    """Return the largest of lengths by body at each row."""
    return np.array([length[b].max(initial=0.0) for b in bodies_of_rows(rows, problem)])


def displacement_ratios(
    problem: GluedProblem, found: Found, length: Vector, least_opening: Vector | float
) -> dict[str, float]:
    """Compare gaps, ties, copies of nodes and supports with the lengths allowed by body."""
    u, finite = found.displacement, np.isfinite(problem.gap)
    gap = np.where(finite, problem.gap, 0.0)
    depth = np.where(finite, least_opening - (problem.gap - problem.rows @ u), 0.0)
    allowed = allowed_at_rows(problem.rows, problem, length) + 1e-12 * np.abs(gap)
    jump = np.array([found.jump[problem.body == b].max() for b in range(problem.bodies)])
    off = np.zeros(problem.bodies)
    error = np.abs(u[problem.fixed] - problem.values)
    np.maximum.at(off, problem.body[problem.fixed // problem.gdim], error)
    torn = np.abs(problem.tied @ u - problem.tied_jump)
    of_ties = allowed_at_rows(problem.tied, problem, length) + 1e-12 * np.abs(problem.tied_jump)
    return {
        "penetration": worst(np.maximum(depth, 0.0), allowed + problem.gap_rounding),
        "tied": worst(torn, of_ties),
        "gluing": worst(jump, length),
        "supports": worst(off, length),
    }


def _of_groups(answer: Answer, values: Vector) -> Vector:
    """Return the sums over the groups, for each body of a group."""
    sums = np.zeros(answer.group.max() + 1)
    np.add.at(sums, answer.group, values)
    each: Vector = sums[answer.group]
    return each


def rigid_part(problem: GluedProblem, body: int, u: Vector) -> Vector:
    R = rigid_modes(problem.coordinates[problem.body == body])
    return R @ (R.T @ u)


def bodies_of_rows(rows: Any, problem: GluedProblem) -> list[NDArray[np.int64]]:
    return [
        np.unique(problem.body[rows.indices[rows.indptr[k] : rows.indptr[k + 1]] // problem.gdim])
        for k in range(rows.shape[0])
    ]


def worst(values: Vector, allowed: Vector) -> float:
    values, allowed = np.asarray(values), np.asarray(allowed)
    ratios = np.where(values > 0.0, values / np.maximum(allowed, np.finfo(float).tiny), 0.0)
    return float(ratios.max(initial=0.0))


def _is_noise(answer: Answer) -> NDArray[np.bool_]:
    """Tell of which bodies the oracle's strains are its rounding errors."""
    noise = np.sqrt(_of_groups(answer, answer.noise**2))
    still: NDArray[np.bool_] = np.sqrt(_of_groups(answer, answer.energy)) <= ROUNDINGS * noise
    return still


def _force_ratio(problem: GluedProblem, answer: Answer, found: Found, rtol: float) -> float:
    """Compare contact forces; their scale is all that acts on the bodies of a group.

    On each body that is the resultant on its free unknowns, and for each contact the sum, where no
    other conditions of its nodes leave the forces undetermined.
    """
    if not problem.gap.size + problem.tied_jump.size:
        return 0.0
    acting, largest = np.zeros(answer.group.max() + 1), np.abs(answer.displacement).max()
    whole, springs = float(answer.energy.sum()), problem.springs
    noise = np.where(_is_noise(answer), answer.noise, 0.0)
    pulls = np.abs(springs.stiffness * (springs.rows @ answer.displacement))
    of_springs = np.bincount(problem.body_of_springs(), pulls, problem.bodies)
    acting += FACTOR * rtol * np.bincount(answer.group, of_springs, acting.size)
    for b in range(problem.bodies):
        at = problem.unknowns(b)
        exact = answer.displacement[at]
        K = problem.elastic[at][:, at]
        local = exact - rigid_part(problem, b, exact)
        here = FACTOR * rtol * np.abs(K @ local).sum() + 1e-14 * (abs(K) @ np.abs(exact)).sum()
        if answer.energy[b] <= AT_REST**2 * whole:
            # the energy norm of its error may be AT_REST of all bodies'
            here += AT_REST * np.sqrt(whole * abs(K).max())
        here += noise[b] * np.sqrt(abs(K).max())
        # and what rounding of the largest motion may strain
        acting[answer.group[b]] += here + 1e-13 * abs(K).max() * largest
    # what rounding makes of the forces on other bodies
    allowed_body = acting[answer.group] + 1e-12 * acting.sum() / (FACTOR * rtol)
    difference = found.force - answer.force
    change = problem.rows.T @ difference + problem.tied.T @ (found.tied - answer.tied)
    nodal = (problem.is_free * change).reshape(-1, problem.gdim)
    resultant = np.zeros((problem.bodies, problem.gdim))
    np.add.at(resultant, problem.body, nodal)
    ratio = worst(np.abs(resultant).max(axis=1), allowed_body)

    unique = problem.determined_rows()
    allowed_row = allowed_at_rows(problem.rows, problem, allowed_body)
    for contact in np.unique(problem.contact):
        at = problem.contact == contact
        allowed = allowed_row[at].max()
        total = float(found.force[at].sum())
        sums = [total - found.contact_force[contact], max(0.0, -float(found.force[at].min()))]
        if unique[at].all():
            sums.append(float(difference[at].sum()))
        ratio = max(ratio, worst(np.abs(sums), np.full(len(sums), allowed)))
    return ratio


def agree(comm: MPI.Comm, found: Found) -> str:
    """Return how the ranks differ; empty if they do not."""
    mine = (type(found.error).__name__ if found.error else "", found.contact_force, found.products)
    every = comm.allgather(mine)
    return "" if all(one == every[0] for one in every) else f"by rank: {every}"
