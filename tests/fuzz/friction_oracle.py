"""The conditions of problems with friction, measured on what the package returned.

Given displacements, contact and friction forces fulfil the conditions of the problem with the slip
bounds r that the forces have if

    f - Ku - C'lambda - S't - T'tau = o,    lambda >= 0,  Cu <= gap,  lambda'(gap - Cu) = 0,
    |t| <= r,  r |s| = t's

at each site, with the slip s. That problem is convex. For any u, lambda and t in these sets

    ||u - u*||^2 <= ||residual||^2 + 2 lambda'(gap - Cu) + 2 sum of (r |s| - t's)

in the energy norm, that of the residual dual to it (Prager and Synge). With Coulomb's law the
bounds have to be those of the contact forces, too. Stiffness and loads are those of the glued
problem; a conic solver tells whether forces can balance the load. Nothing is shared with the
package.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import clarabel
import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from glued import GluedProblem, rigid_modes
from numpy.typing import NDArray
from oracle import Answer, Unsure, infeasibility, without_a_solution
from outcome import (
    AT_REST,
    FACTOR,
    OF_ALL,
    OF_GROUP,
    ROUNDINGS,
    UNDEFORMED,
    Found,
    Outcome,
    allowed_at_rows,
    bodies_of_rows,
    displacement_ratios,
    outcome_of,
    rigid_part,
    rounded_lengths,
    scale_of_rounding,
    without_solution,
    worst,
)
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import InputError, NotConverged
from fenics_tfeti.feti.dual.iterate import SolveStatus

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


# part of a load that is left where forces certainly balance it, and where they certainly do not
_BALANCED, _UNBALANCED = 1e-8, 1e-6
# forces on all bodies, relative to those on one, whose rounding is as large as what it may leave
_OF_OTHERS = 1e-5
_EPS = float(np.finfo(float).eps)
# words of the package where supports slide what friction holds in another direction, where they
# leave the force of Coulomb's law unknown, and where its fixed point does not contract
_PRESCRIBED, _UNKNOWN = "prescribed displacements slide", "the normal force is not known"
_NO_CONTRACTION = ("the slip bounds of Coulomb's law do not converge", "no slip bounds near")


def verdict_with_friction(problem: GluedProblem) -> Answer:
    """Tell whether the problem has a solution; without the solution."""
    excess = ""
    try:
        excess = infeasibility(problem)
        motion = _unbalanced(problem)
    except Unsure as error:
        return Answer("infeasible", excess) if excess else Answer("unsure", str(error))
    return without_a_solution(excess, motion) or Answer("solution")


def compare_with_friction(problem: GluedProblem, found: Found, rtol: float) -> Outcome:
    """Return the class of an outcome."""
    error, said = found.error, found.said
    problem, found = _without_prescribed_slips(problem, found)
    if is_refused(problem, found):
        return Outcome("right error", said)
    other = without_solution(verdict_with_friction(problem), found)
    if other is not None:
        return other
    if isinstance(error, NotConverged):
        if any(words in said for words in _NO_CONTRACTION):
            return Outcome("no contraction", said)
        if SolveStatus.AT_LIMIT.value in said and found.displacement is not None:
            # what rounding makes is known of an iterate alone
            outcome = _Measured(problem, found, rtol).outcome()
            if outcome.kind == "right":
                return replace(outcome, kind="limit of rounding", detail=f"{said}; it is right")
        return Outcome("no convergence", said)
    if error is not None:
        return Outcome("false error", said)
    return _Measured(problem, found, rtol).outcome()


def is_refused(problem: GluedProblem, found: Found) -> bool:
    """Tell whether the package refuses friction for a reason that the problem has."""
    return isinstance(found.error, InputError) and (
        (_PRESCRIBED in found.said and _slides_one_way(problem))
        or (_UNKNOWN in found.said and _has_unknown_bound(problem))
    )


def _without_prescribed_slips(problem: GluedProblem, found: Found) -> tuple[GluedProblem, Found]:
    """Leave out the sites whose slips are prescribed: their forces act on supports alone."""
    friction = problem.friction
    assert friction is not None
    moves = (abs(friction.rows) @ problem.is_free).reshape(friction.before.shape)
    slide = (moves > 1e-8).any(axis=1)
    if found.displacement is not None:
        found = replace(found, tangential=found.tangential[slide])
    return replace(problem, friction=friction.at(slide)), found


def _slides_one_way(problem: GluedProblem) -> bool:
    """Tell whether one direction of a slip is free and the other one prescribed, not zero."""
    friction = problem.friction
    assert friction is not None
    slips = friction.slips(problem.known)
    rows = friction.rows[:, problem.is_free].toarray().reshape(*slips.shape, -1)
    directions, sizes, _ = np.linalg.svd(rows, full_matrices=False)
    along = np.einsum("kij,ki->kj", directions, slips)
    return bool(((sizes < 1e-8) & (np.abs(along) > 0.0)).any())


def _has_unknown_bound(problem: GluedProblem) -> bool:
    """Tell whether conditions leave a normal force undetermined that Coulomb's law needs."""
    friction = problem.friction
    assert friction is not None
    needed = friction.row[friction.coefficient > 0.0]
    return not problem.determined_rows()[needed].all()


# -- whether forces balance the load ---------------------------------------------------------------


def _unbalanced(problem: GluedProblem) -> str:
    """Tell how much of the load the best forces leave, by a conic programme for each component."""
    friction = problem.friction
    assert friction is not None
    finite = np.flatnonzero(np.isfinite(problem.gap))
    rows = [problem.rows[finite], friction.rows, problem.springs.rows, problem.tied]
    motions = [_motions(problem, b) for b in range(problem.bodies)]
    touched = sp.vstack(rows).tocsr()
    of_body = sp.csr_matrix(
        (
            np.ones(problem.load.size),
            (np.arange(problem.load.size), np.repeat(problem.body, problem.gdim)),
        )
    )
    joined = abs(touched) @ of_body
    label = connected_components(joined.T @ joined, directed=False)[1]
    for component in range(label.max() + 1):
        bodies = np.flatnonzero(label == component)
        N = np.hstack([motions[b] for b in bodies])
        of_motion = np.repeat(np.arange(bodies.size), [motions[b].shape[1] for b in bodies])
        load = max(np.abs(problem.load[problem.unknowns(b)]).sum() for b in bodies)
        e = N.T @ problem.load
        if not np.linalg.norm(e) > 1e-12 * load:
            continue
        left, sizes = _least_imbalance(problem, finite, N, e / load, load)
        if left > _UNBALANCED:
            return f"{left:.1e} of the load is left on bodies {bodies.tolist()}"
        if left > _BALANCED:
            raise Unsure(f"forces balance the load up to {left:.1e}")
        # what is rounding of the largest load may be all that acts on a body
        largest = np.zeros(bodies.size)
        np.maximum.at(largest, of_motion, sizes)
        unit = (largest + _OF_OTHERS * largest.sum())[of_motion]
        left, _ = _least_imbalance(problem, finite, N / unit, e / load / unit, load)
        if left > _UNBALANCED:
            raise Unsure(f"forces balance the load on a body up to {left:.1e} of what acts on it")
    return ""


def _motions(problem: GluedProblem, body: int) -> Vector:
    """Return the rigid motions (n, k) of a body that its supports leave."""
    at = problem.unknowns(body)
    R = rigid_modes(problem.coordinates[problem.body == body])
    held = R[np.isin(at, problem.fixed)]
    free = la.null_space(held, rcond=1e-10) if len(held) else np.eye(R.shape[1])
    N = np.zeros((problem.load.size, free.shape[1]))
    N[at] = R @ free
    return N


def _least_imbalance(
    problem: GluedProblem, finite: Numbers, N: Vector, e: Vector, unit: float
) -> tuple[float, Vector]:
    """Return min |N'(C'x + S'y + free forces) - e| over forces within their bounds.

    With it the sum of the magnitudes of its terms for each motion.
    """
    friction = problem.friction
    assert friction is not None
    C, S = (problem.rows[finite] @ N).T, (friction.rows @ N).T
    other = (sp.vstack([problem.springs.rows, problem.tied]) @ N).T
    lengths = np.linalg.norm(other, axis=0)
    other = other[:, lengths > 1e-12] / lengths[lengths > 1e-12]
    m, k, d = finite.size, friction.size, problem.gdim - 1
    matrix = np.hstack([C, S, other])
    n = matrix.shape[1] + 1
    place = np.full(problem.gap.size, -1)
    place[finite] = np.arange(m)
    push = sp.lil_matrix((m, n))
    push[np.arange(m), np.arange(m)] = -1.0
    sites = sp.lil_matrix((k * (d + 1), n))
    right = np.zeros(k * (d + 1))
    right[:: d + 1] = friction.bound / unit
    for j in range(k):
        if place[friction.row[j]] >= 0:
            sites[(d + 1) * j, place[friction.row[j]]] = -friction.coefficient[j]
        for i in range(d):
            sites[(d + 1) * j + 1 + i, m + d * j + i] = -1.0
    balance = np.zeros((e.size + 1, n))
    balance[0, -1] = -1.0
    balance[1:, :-1] = matrix
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.NonnegativeConeT(m)] * (m > 0)
    cones += [clarabel.SecondOrderConeT(d + 1)] * k + [clarabel.SecondOrderConeT(e.size + 1)]
    cost = np.append(np.zeros(n - 1), 1.0)
    solution = clarabel.DefaultSolver(
        sp.csc_matrix((n, n)),
        cost,
        sp.csc_matrix(sp.vstack([push, sites, sp.csr_matrix(balance)])),
        np.concatenate([np.zeros(m), right, [0.0], e]),
        cones,
        settings,
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise Unsure(f"balance of forces: {solution.status}")
    sizes = np.abs(matrix) @ np.abs(np.asarray(solution.x)[:-1]) + np.abs(e)
    return float(solution.obj_val), sizes


# -- the conditions --------------------------------------------------------------------------------


@dataclass
class _Measured:
    """The conditions of what was found, each relative to what is allowed."""

    problem: GluedProblem
    found: Found
    rtol: float

    def outcome(self) -> Outcome:
        """Return the class."""
        u, problem = self.found.displacement, self.problem
        friction = problem.friction
        assert u is not None
        assert friction is not None
        if not np.isfinite(u).all():
            return Outcome("wrong", "displacements are not finite")
        self.u, self.friction = u, friction
        bodies = range(problem.bodies)
        self.local = u.copy()
        for b in bodies:
            at = problem.unknowns(b)
            self.local[at] -= rigid_part(problem, b, u[at])
        at = [problem.unknowns(b) for b in bodies]
        self.deformation = np.array([np.abs(self.local[i]).max() for i in at])
        size = np.array([np.abs(u[i]).max() for i in at])
        K = (problem.elastic + problem.springs.matrix()).tocsr()
        rounding = rounded_lengths(problem, size, K)
        self.length = FACTOR * self.rtol * self.deformation + rounding
        return outcome_of({**self._displacements(), **self._forces(), **self._energies(K)})

    def _displacements(self) -> dict[str, float]:
        """Compare gaps, slips below the bound, ties, copies of nodes and supports."""
        problem, friction = self.problem, self.friction
        slip = np.linalg.norm(friction.slips(self.u), axis=1)
        below = (self._size() < (1.0 - 1e-8) * self._bounds()) & ~self._at_bound()
        before = 1e-12 * np.linalg.norm(friction.before, axis=1)
        of_sites = allowed_at_rows(problem.rows[friction.row], problem, self.length)
        sliding = {"slip below the bound": worst(slip * below, of_sites + before)}
        return sliding | displacement_ratios(problem, self.found, self.length, 0.0)

    def _size(self) -> Vector:
        return np.linalg.norm(self.found.tangential, axis=1)

    def _bounds(self) -> Vector:
        """Return the slip bounds that the contact forces make, those that are rounding none."""
        friction, force = self.friction, self.found.force
        pressing = np.where(force > 1e-12 * np.abs(force).max(initial=0.0), force, 0.0)
        return friction.bound + friction.coefficient * pressing[friction.row]

    def _at_bound(self) -> NDArray[np.bool_]:
        """Tell where the friction force is the bound, up to the error of Coulomb's law."""
        bounds = self._bounds()
        error = FACTOR * self.rtol * np.linalg.norm(bounds) * (self.friction.coefficient > 0.0)
        return self._size() >= bounds * (1.0 - 1e-8) - error

    def _forces(self) -> dict[str, float]:
        """Compare the forces with their bounds, and with their sums."""
        problem, found, force = self.problem, self.found, self.found.force
        bounds, size = self._bounds(), self._size()
        given = self.friction.coefficient == 0.0
        excess = np.maximum(size - bounds, 0.0)
        whole = max(np.linalg.norm(bounds), np.linalg.norm(size))
        largest = float(np.abs(force).max(initial=0.0))
        sums = np.bincount(problem.contact, weights=force, minlength=len(found.contact_force))
        return {
            "negative force": worst(np.maximum(-force, 0.0), np.full(force.size, 1e-12 * largest)),
            "friction above a given bound": worst(excess[given], 1e-7 * bounds[given]),
            "friction above Coulomb's bound": float(
                np.linalg.norm(excess) / max(FACTOR * self.rtol * whole, 1e-300)
            ),
            "sums of forces": worst(
                np.abs(sums - found.contact_force), np.full(sums.size, 1e-9 * largest * force.size)
            ),
        }

    def _energies(self, K: sp.csr_matrix) -> dict[str, float]:
        """Compare the bound of the error with the energy norm of each group and body, and J."""
        problem, found, friction = self.problem, self.found, self.friction
        stretch = problem.springs.rows @ self.u
        spring_force = problem.springs.stiffness * stretch
        energy = np.bincount(
            problem.body_of_springs(), stretch * spring_force, problem.bodies
        ).astype(float)
        pulls = [
            (problem.springs.rows, spring_force),
            (problem.rows, found.force),
            (problem.tied, found.tied),
            (friction.rows, found.tangential.ravel()),
        ]
        residual, size = problem.load - problem.elastic @ self.local, np.abs(problem.load)
        size = size + abs(problem.elastic) @ np.abs(self.local)
        for rows, force in pulls:
            residual -= rows.T @ force
            size += abs(rows).T @ np.abs(force)
        error2, noise2, imbalance = (np.zeros(problem.bodies) for _ in range(3))
        for b in range(problem.bodies):
            at = problem.unknowns(b)
            energy[b] += max(
                0.0, float(self.local[at] @ (problem.elastic[at][:, at] @ self.local[at]))
            )
            error2[b], noise2[b], imbalance[b] = _dual_norms(problem, b, K, residual, size)
        of_body = np.bincount(np.repeat(problem.body, problem.gdim), weights=size)
        imbalance /= np.maximum(1e-9 * (of_body + _OF_OTHERS * of_body.sum()), 1e-300)
        slips = friction.slips(self.u)
        bounds = np.where(self._at_bound(), self._size(), self._bounds())
        finite = np.isfinite(problem.gap)
        opening = np.where(finite, problem.gap, 0.0) - problem.rows @ self.u
        pressing = finite & (found.force > 0.0)
        rubbing = bounds * np.linalg.norm(slips, axis=1)
        unused = np.maximum(rubbing - np.sum(slips * found.tangential, axis=1), 0.0)
        works = [
            (bodies_of_rows(problem.rows, problem), 2.0 * np.abs(found.force * opening * pressing)),
            (bodies_of_rows(problem.rows[friction.row], problem), 2.0 * unused),
        ]
        group = self._groups(pressing)
        of_groups = np.zeros((3, group.max() + 1))
        lost = np.zeros(problem.bodies)
        rounded = [
            abs(problem.rows) @ np.abs(self.u)
            + np.where(finite, np.abs(problem.gap), 0.0)
            + problem.gap_rounding / _EPS,
            np.linalg.norm(
                (abs(friction.rows) @ np.abs(self.u)).reshape(slips.shape)
                + np.abs(friction.before),
                axis=1,
            ),
        ]
        forces = np.abs(found.force) * pressing, bounds
        for (bodies, work), length, force in zip(works, rounded, forces, strict=True):
            first = [b.min() for b in bodies]
            np.add.at(lost, first, work)
            # rounding of lengths, of which the forces make work
            np.add.at(noise2, first, 4.0 * _EPS * force * length / ROUNDINGS**2)
        np.add.at(of_groups.T, group, np.column_stack([error2 + lost, energy, noise2]))
        motion, load = scale_of_rounding(problem, np.abs(self.u).max(), K)
        floor = 1e-15 * motion + 1e-12 * load + ROUNDINGS * np.sqrt(of_groups[2][group])
        # the package calls strains rounding up to this part of motions and loads
        none = UNDEFORMED * (motion + load)
        floor = floor + none * (of_groups[1][group] <= none**2)
        whole = float(energy.sum())
        # bodies that do not deform
        floor = floor + AT_REST * np.sqrt(whole) * (energy <= AT_REST**2 * whole)
        least = OF_ALL**2 * whole
        of_group = np.sqrt(np.maximum(of_groups[1][group], least))
        of_body = np.sqrt(
            np.maximum.reduce([energy, OF_GROUP**2 * of_groups[1][group], 0 * energy + least])
        )
        tolerance = FACTOR * self.rtol
        # what rounding may leave in one body is no error of the others of its group
        floor_of_group = np.sqrt(np.bincount(group, floor**2))[group]
        exact = 0.5 * whole - float(problem.load @ self.u) + float(rubbing.sum())
        noise = 1e-12 * float(np.abs(problem.load) @ np.abs(self.u)) + float((floor**2).sum())
        noise += 1e-13 * float(np.abs(self.u) @ abs(K) @ np.abs(self.u))
        return {
            "error": worst(np.sqrt(of_groups[0][group]), tolerance * of_group + floor_of_group),
            "error of a body": worst(np.sqrt(error2), tolerance * of_body + floor),
            "balance": float(imbalance.max()),
            "energy": worst(
                np.array([abs(found.energy - exact)]),
                np.array([tolerance * max(abs(exact), whole) + noise]),
            ),
        }

    def _groups(self, pressing: NDArray[np.bool_]) -> Numbers:
        """Return the group of each body: bodies that press on each other, rub, or are tied."""
        problem, friction = self.problem, self.friction
        rubbing = friction.row[self._bounds() > 0.0]
        rows = sp.vstack([problem.rows[pressing], problem.rows[rubbing], problem.tied]).tocsr()
        graph = np.eye(problem.bodies)
        for bodies in bodies_of_rows(rows, problem):
            graph[np.ix_(bodies, bodies)] = 1.0
        group: Numbers = connected_components(graph, directed=False)[1].astype(np.int64)
        return group


def _dual_norms(
    problem: GluedProblem, body: int, K: sp.csr_matrix, residual: Vector, size: Vector
) -> tuple[float, float, float]:
    """Return r'K^+r of a residual and of its rounding, and the residual's rigid part [N]."""
    at = problem.unknowns(body)
    free = at[~np.isin(at, problem.fixed)]
    if not free.size:
        return 0.0, 0.0, 0.0
    R = rigid_modes(problem.coordinates[problem.body == body])
    springs = problem.springs.rows[:, at].toarray()
    lengths = np.linalg.norm(springs, axis=1)
    springs = springs[lengths > 0.0] / lengths[lengths > 0.0, None]
    held = np.vstack([np.eye(at.size)[np.isin(at, problem.fixed)], springs]) @ R
    N = R @ (la.null_space(held, rcond=1e-10) if len(held) else np.eye(R.shape[1]))
    N = N[np.isin(at, free)]
    dense = K[free][:, free].toarray()
    scale = 1.0 / np.sqrt(dense.diagonal())
    if N.shape[1]:
        N = np.linalg.qr(N)[0]
        dense += dense.diagonal().max() * N @ N.T
    factor = la.cho_factor(scale[:, None] * dense * scale)
    rng = np.random.default_rng(0)
    norms = []
    for r in (residual[free], _EPS * size[free] * rng.choice([-1.0, 1.0], free.size)):
        r = r - N @ (N.T @ r)
        norms.append(max(0.0, float(scale * r @ la.cho_solve(factor, scale * r))))
    rigid = float(np.abs(N.T @ residual[free]).max(initial=0.0))
    return norms[0], norms[1], rigid
