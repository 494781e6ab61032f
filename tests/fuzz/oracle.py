"""An independent dense solver of the glued problem, which checks itself before it is trusted.

The elastic deformation of each body is eliminated by dense factors; what remains are the contact
forces, the spring forces and the rigid motions of bodies:

    u = K^+(f - B'w) + N alpha,   B = [C; S; T],  w = (lambda, sigma, tau),

    min 1/2 w' Phi w - d'w   subject to   A w = e,  lambda >= 0,

with Phi = B K^+ B' + diag(0, 1/k, 0), A = N'B', e = N'f; S are springs, T tied rows. Every row is
scaled by its own compliance, so stiff and soft bodies, springs of 1e-13 and gaps of 1e10 do not
meet in one sum. An interior point method proposes the active set, a primal-dual active set method
makes it exact, and the conditions of optimality are measured in the energy norm. Nothing is shared
with the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from glued import GluedProblem, rigid_modes
from numpy.typing import NDArray
from scipy.optimize import linprog, nnls
from scipy.sparse.csgraph import connected_components

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]


# a resistance or a violation between these two, relative to what is compared, is called unsure
_CERTAINLY_ZERO, _CERTAINLY_NOT = 1e-12, 1e-10
# eigenvalues of an equilibrated saddle point matrix that count as zero
_SINGULAR = 1e-13
# entries of rows of unit length that are rounding errors
_TRACE = 1e-14
_EPS = float(np.finfo(float).eps)

Verdict = Literal["solution", "infeasible", "unbounded", "infeasible and unbounded", "unsure"]


def _none() -> Any:
    return field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Answer:
    """What the oracle says about a problem.

    It has a solution; it is "infeasible" if no displacement fulfils the conditions, "unbounded" if
    the load does work on a motion that nothing resists, or both; "unsure" if rounding decides.
    """

    verdict: Verdict
    why: str = ""
    displacement: Vector = _none()  # (n,); motions that nothing determines are chosen somehow
    force: Vector = _none()  # (m,), lambda
    tied: Vector = _none()  # (t,), tau
    energy: Vector = _none()  # (bodies,), u'(K + springs)u
    group: Numbers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # pressing bodies
    noise: Vector = _none()  # (bodies,), what rounding the data does to u, in the energy norm
    error: Vector = _none()  # (bodies,), about the bound of the oracle's own error in the same norm


class Unsure(Exception):
    """The oracle cannot tell."""


def solve(problem: GluedProblem) -> Answer:
    """Solve a problem, or say why it has no solution."""
    try:
        excess = infeasibility(problem)
        condensed = _Condensed(problem)
        motion = condensed.unresisted_motion()
        return without_a_solution(excess, motion) or condensed.solve()
    except Unsure as error:
        return Answer("unsure", str(error))


def without_a_solution(excess: str, motion: str) -> Answer | None:
    """Return the answer where conditions exclude each other or the load moves a body."""
    if excess and motion:
        return Answer("infeasible and unbounded", f"{excess}; {motion}")
    if excess or motion:
        return Answer("infeasible" if excess else "unbounded", excess or motion)
    return None


# -- feasibility -----------------------------------------------------------------------------------


def infeasibility(problem: GluedProblem) -> str:
    """Tell whether the conditions exclude each other: a linear programme for each set of nodes."""
    u = problem.known
    finite = np.flatnonzero(np.isfinite(problem.gap))
    # a tied row is two conditions
    rows = sp.vstack([problem.rows[finite], problem.tied, -problem.tied]).tocsr()
    gap = np.concatenate([problem.gap[finite], problem.tied_jump, -problem.tied_jump])
    rounding = np.append(problem.gap_rounding[finite], np.zeros(2 * problem.tied_jump.size))
    C = rows[:, problem.is_free].toarray()
    known = rows @ u
    bound = gap - known
    # conditions are compared to twelve digits of what they are made of, and of what that is made of
    size = abs(gap) + abs(rows) @ abs(u) + rounding / _EPS
    blocks, block = connected_components((C != 0.0) @ (C != 0.0).T, directed=False)
    for b in range(blocks):
        at = np.flatnonzero(block == b)
        if (bound[at] >= 0.0).all():
            continue
        weights, violation = _farkas(C[at], bound[at])
        scale = float(size[at][weights > 0.0].max(initial=0.0))
        if violation > 1e-9 * scale:
            return f"violated by {violation:.3e} where gaps and displacements are {scale:.3e}"
        if violation > 1e-12 * scale:
            raise Unsure(f"conditions violated by {violation / scale:.1e}")
    return ""


def _farkas(C: Vector, bound: Vector) -> tuple[Vector, float]:
    """Return the weights of rows that contradict each other most, and by how much."""
    lengths = np.linalg.norm(C, axis=1)
    if len(C) == 1 or not lengths.any():
        worst = int(np.argmin(np.where(lengths > 1e-10, np.inf, bound)))
        return np.eye(len(C))[worst], max(
            0.0, -float(bound[worst]) if lengths[worst] < 1e-10 else 0
        )
    scale = np.abs(bound[bound < 0]).max()
    columns = np.flatnonzero(np.abs(C).max(axis=0) > 0.0)
    equal = np.vstack([C[:, columns].T, np.ones(len(C))])
    right = np.append(np.zeros(columns.size), 1.0)
    # far gaps have no part in a contradiction
    cost = np.minimum(bound / scale, 1e3)
    result = linprog(cost, A_eq=equal, b_eq=right, bounds=(0.0, None), method="highs-ds")
    if result.status == 2:  # no weights: the rows do not oppose each other
        return np.zeros(len(C)), 0.0
    if result.status != 0:
        raise Unsure(f"feasibility: {result.message}")
    return result.x, max(0.0, -result.fun * scale)


# -- one body --------------------------------------------------------------------------------------


class _Body:
    """The elastic part of one body: K^+, and the rigid motions N that its supports leave."""

    def __init__(self, problem: GluedProblem, number: int) -> None:
        every = problem.unknowns(number)
        fixed = np.isin(every, problem.fixed)
        value = dict(zip(problem.fixed.tolist(), problem.values.tolist(), strict=True))
        self.unknowns = every
        self.free = np.flatnonzero(~fixed)
        K = problem.elastic[every][:, every].toarray()
        R = rigid_modes(problem.coordinates[problem.body == number])
        g = np.array([value[int(i)] for i in every[fixed]])
        held = R[fixed]
        # a rigid motion that the supports prescribe is taken out: it would only be cancelled
        motion = np.linalg.lstsq(held, g, rcond=1e-10)[0] if g.size else np.zeros(R.shape[1])
        self.shift = R @ motion
        self.lift = np.zeros(every.size)
        self.lift[fixed] = g - held @ motion
        N = R @ _null_space(held, f"supports of body {number}")
        self.N = np.linalg.qr(N[self.free])[0] if N.shape[1] else np.zeros((self.free.size, 0))
        self.K = K[np.ix_(self.free, self.free)]
        self.K_lift = (K @ self.lift)[self.free]
        self.full_K = K
        # the size of what is summed
        moved = np.abs(K) @ np.abs(self.lift + self.shift)
        self.forces = float(np.sum(np.abs(problem.load[every][self.free]) + moved[self.free]))
        self.root = 1.0 / np.sqrt(np.maximum(self.K.diagonal(), np.finfo(float).tiny))
        pinned = self.K + self.K.diagonal().max(initial=0.0) * self.N @ self.N.T
        self._factor = (
            la.cho_factor(self.root[:, None] * pinned * self.root)
            if N.size
            else (
                la.cho_factor(self.root[:, None] * self.K * self.root) if self.free.size else None
            )
        )
        self._pinned = pinned.astype(np.longdouble)

    def solve(self, x: Vector) -> Vector:
        """Return K^+ x on the free unknowns, without rigid motions; x is taken without them."""
        if not self.free.size:
            return x
        x = x - self.N @ (self.N.T @ x)
        y = np.zeros_like(x)
        left = x
        for _ in range(3):
            step = (la.cho_solve(self._factor, (left.T * self.root).T).T * self.root).T
            y = y + step
            left = (x - self._pinned @ y).astype(float)
        return y - self.N @ (self.N.T @ y)


def _null_space(rows: Vector, what: str) -> Vector:
    """Return an orthonormal basis of the motions that rows of about unit length do not see."""
    if not len(rows):
        return np.eye(rows.shape[1])
    _, s, v = np.linalg.svd(rows, full_matrices=True)
    s = np.append(s, np.zeros(rows.shape[1] - s.size))
    if np.any((s > _CERTAINLY_ZERO) & (s < 1e-8)):
        raise Unsure(f"{what}: a motion is resisted by {s[s > _CERTAINLY_ZERO].min():.1e} only")
    return v[s <= _CERTAINLY_ZERO].T


# -- the condensed problem -------------------------------------------------------------------------


class _Condensed:
    """Phi, A, d and e, scaled; see the head of this file."""

    def __init__(self, problem: GluedProblem) -> None:
        self.problem = problem
        bodies = self.bodies = [_Body(problem, b) for b in range(problem.bodies)]
        self.finite = np.flatnonzero(np.isfinite(problem.gap))
        self.m = self.finite.size
        springs = problem.springs
        C, S = problem.rows[self.finite], sp.vstack([springs.rows, problem.tied]).tocsr()
        rows, k = self.m + S.shape[0], springs.stiffness
        # the end of the springs; tied rows follow
        self.end = self.m + k.size
        Phi = np.zeros((rows, rows))
        Phi[self.m : self.end, self.m : self.end] = np.diag(1.0 / k)
        jumps = np.append(np.zeros(k.size), problem.tied_jump)
        A, e, d = [], [], -np.append(problem.gap[self.finite], jumps)
        self.B, self.f = [], []
        self.touched = np.zeros((rows, len(bodies)), dtype=bool)
        self.shift = np.zeros(rows)
        for number, body in enumerate(bodies):
            of_body = np.vstack([C[:, body.unknowns].toarray(), S[:, body.unknowns].toarray()])
            B, f = of_body[:, body.free], problem.load[body.unknowns][body.free] - body.K_lift
            self.touched[:, number] = np.abs(B).max(axis=1, initial=0.0) > 0.0
            at = np.flatnonzero(self.touched[:, number])
            Phi[np.ix_(at, at)] += B[at] @ body.solve(B[at].T.copy())
            d += B @ body.solve(f) + of_body @ body.lift
            self.shift += of_body @ body.shift
            A.append(body.N.T @ B.T)
            e.append(body.N.T @ f)
            self.B.append(B)
            self.f.append(f)
        d += self.shift
        self.alpha_of = np.cumsum([0, *(len(part) for part in A)])
        self.Phi, self.d = 0.5 * (Phi + Phi.T), d
        self.A = np.concatenate(A) if A else np.zeros((0, rows))
        self.e = np.concatenate(e) if e else np.zeros(0)
        # rows between prescribed displacements only were decided before
        self.movable = self.touched.any(axis=1)
        diagonal = self.Phi.diagonal()
        self.scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 0)

    def _components(self) -> list[tuple[Numbers, Numbers]]:
        """Return (bodies, rows) of the parts of the problem that conditions may connect."""
        touched = self.touched.astype(float)
        count, label = connected_components(touched.T @ touched, directed=False)
        first = np.where(self.movable, np.argmax(self.touched, axis=1), -1)
        of_row = np.where(first >= 0, label[first], -1)
        return [(np.flatnonzero(label == c), np.flatnonzero(of_row == c)) for c in range(count)]

    def _alphas(self, bodies: Numbers) -> Numbers:
        return np.concatenate(
            [np.arange(self.alpha_of[b], self.alpha_of[b + 1]) for b in bodies]
        ).astype(np.int64)

    def unresisted_motion(self) -> str:
        """Tell whether the load does work on a motion that nothing resists."""
        for bodies, rows in self._components():
            alphas = self._alphas(bodies)
            if not alphas.size:
                continue
            inequality, springs = rows[rows < self.m], rows[rows >= self.m]
            C, S = self.A[np.ix_(alphas, inequality)], self.A[np.ix_(alphas, springs)]
            S = S / np.maximum(np.linalg.norm(self._row_vectors(springs), axis=1), 1e-300)
            Z = _null_space(S.T, "springs")
            C, e = Z.T @ C, Z.T @ self.e[alphas]
            load = max(np.abs(self.f[b]).sum() for b in bodies)
            if not np.linalg.norm(e) > _CERTAINLY_ZERO * load:
                continue
            columns = np.linalg.norm(C, axis=0) > _CERTAINLY_ZERO
            if columns.any():
                push, _ = nnls(C[:, columns], e / np.linalg.norm(e), maxiter=100 * C.shape[1] + 100)
                left = np.linalg.norm(e) * (e / np.linalg.norm(e) - C[:, columns] @ push)
            else:
                left = e
            work = float(np.linalg.norm(left)) / load
            if work > 1e-9:
                return f"work {work:.1e} of the load on a motion of bodies {bodies.tolist()}"
            if work > 1e-13 * max(1.0, 1.0 if not columns.any() else float(push.sum())):
                raise Unsure(f"a motion on which the load does work {work:.1e}")
        return ""

    def _row_vectors(self, rows: Numbers) -> Vector:
        return np.hstack([B[rows] for B in self.B]) if rows.size else np.zeros((0, 1))

    def solve(self) -> Answer:
        """Solve part by part, and measure the result."""
        w, alpha = np.zeros(self.d.size), np.zeros(self.e.size)
        active = np.zeros(self.d.size, dtype=bool)
        active[self.m :] = True
        for bodies, rows in self._components():
            if rows.size:
                part = _Programme(self, rows, self._alphas(bodies))
                w[rows], alpha[part.alphas], active[rows] = part.solve()
        return _measured(self, w, alpha, active)


class _Programme:
    """The condensed problem of bodies that conditions connect, in scaled unknowns."""

    def __init__(self, whole: _Condensed, rows: Numbers, alphas: Numbers) -> None:
        self.rows, self.alphas, self.scale = rows, alphas, whole.scale[rows]
        self.inequality = rows < whole.m
        s = self.scale
        self.Phi = s[:, None] * whole.Phi[np.ix_(rows, rows)] * s
        self.d = s * whole.d[rows]
        self.A = whole.A[np.ix_(alphas, rows)] * s
        self.e = whole.e[alphas]
        # motions that no row resists: their amount is arbitrary and stays zero
        if len(alphas):
            lengths = np.linalg.norm(self.A, axis=1).max()
            U, sigma, _ = np.linalg.svd(self.A / max(lengths, 1e-300), full_matrices=False)
            self.basis = U[:, sigma > 1e-12]
        else:
            self.basis = np.zeros((0, 0))
        self.A, self.e = self.basis.T @ self.A, self.basis.T @ self.e
        self.length = np.linalg.norm(self.A, axis=1)
        self.A, self.e = self.A / self.length[:, None], self.e / self.length
        # rounding errors would pass for a resistance when rows are equilibrated
        self.A[np.abs(self.A) < _TRACE] = 0.0

    def response(self, d: Vector, e: Vector, active: Mask) -> Vector:
        """Return how w follows a change of d and e (of the whole problem) with active rows."""
        at = np.flatnonzero(active)
        change = self.basis.T @ e[self.alphas] / self.length
        right = np.append((self.scale * d[self.rows])[at], -change)
        w = np.zeros(active.size)
        w[at] = _symmetric_solve(self._saddle(at), right)[0][: at.size]
        return self.scale * w

    def solve(self) -> tuple[Vector, Vector, Mask]:
        """Return w, alpha and the active rows."""
        near = self._near()
        for _ in range(12):
            start = self._interior_point(near)
            try:
                w, alpha, active = self._dual_active_set(start, near)
            except Unsure:
                w, alpha, active = self._primal_active_set(start, near)
            opening = self.Phi @ w - self.d - self.A.T @ alpha
            missed = self.inequality & ~near & (opening < 0.0)
            if not missed.any():
                return self.scale * w, self.basis @ (alpha / self.length), active
            near = near | missed
        raise Unsure("the rows that matter were not found")

    def _near(self) -> Mask:
        """Return the rows that may close, generously: far gaps have a scale of their own."""
        far = -self.d
        reach = max(np.linalg.norm(self.e), float(np.abs(self.d[~self.inequality]).max(initial=0)))
        reach = max(reach, float(self.d[self.inequality].max(initial=0.0)))
        near = ~self.inequality | (far <= 1e3 * reach)
        held = np.linalg.matrix_rank(self.A[:, near], tol=1e-9) if len(self.A) else 0
        # what holds a body has to be among them
        for limit in np.sort(far[~near]):
            if held == len(self.A) and self._balanced(near):
                break
            near = near | (far <= limit * (1 + 1e-9) + 0.0)
            held = np.linalg.matrix_rank(self.A[:, near], tol=1e-9)
        return near

    def _balanced(self, near: Mask) -> bool:
        """Tell whether the near rows can carry the load."""
        if not len(self.e) or not self.e.any():
            return True
        signed = np.hstack([self.A[:, near], -self.A[:, near & ~self.inequality]])
        norm = np.linalg.norm(self.e)
        _, left = nnls(signed, self.e / norm, maxiter=100 * signed.shape[1] + 100)
        return bool(left <= 1e-9)

    def _interior_point(self, near: Mask) -> tuple[Vector, Mask]:
        """Return w and the rows that press or are springs, by Mehrotra's method."""
        at = np.flatnonzero(near)
        ineq = self.inequality[at]
        every = np.zeros(self.d.size)
        if not ineq.any():
            return every, near.copy()
        Phi, A, d, e = self.Phi[np.ix_(at, at)], self.A[:, at], self.d[at], self.e
        size = max(float(np.abs(d).max(initial=0.0)), float(np.abs(e).max(initial=0.0)))
        if size == 0.0:
            return every, near & ~self.inequality
        d, e = d / size, e / size
        n, r, k = at.size, len(A), int(ineq.sum())
        w = np.where(ineq, 1.0, 0.0)
        z, alpha = np.ones(k), np.zeros(r)
        for _ in range(60):
            r_w = d - Phi @ w + A.T @ alpha
            r_w[ineq] += z
            r_a = e - A @ w
            lam = w[ineq]
            mu = float(lam @ z) / k
            if mu < 1e-15 and max(np.abs(r_w).max(), np.abs(r_a).max(initial=0.0)) < 1e-11:
                break
            M = np.zeros((n + r, n + r))
            M[:n, :n] = Phi
            M[np.flatnonzero(ineq), np.flatnonzero(ineq)] += z / lam
            M[:n, :n] += 1e-15 * np.eye(n)
            M[:n, n:], M[n:, :n] = -A.T, -A
            M[n:, n:] -= 1e-15 * np.eye(r)
            try:
                factor = la.lu_factor(M)
            except (ValueError, la.LinAlgError):
                break

            def step(target, factor=factor, r_w=r_w, r_a=r_a, z=z, lam=lam):
                right = r_w.copy()
                right[ineq] += target / lam - z
                move = la.lu_solve(factor, np.concatenate([right, -r_a]))
                dw, da = move[:n], move[n:]
                return dw, da, target / lam - z - z / lam * dw[ineq]

            dw, da, dz = step(np.zeros(k))
            length = min(_largest(lam, dw[ineq]), _largest(z, dz))
            centre = (float((lam + length * dw[ineq]) @ (z + length * dz)) / k / mu) ** 3
            dw, da, dz = step(np.maximum(centre, 1e-6) * mu - length * dw[ineq] * dz)
            length = min(1.0, 0.995 * min(_largest(lam, dw[ineq]), _largest(z, dz)))
            if not np.isfinite(length) or length < 1e-10:
                break
            w, alpha, z = w + length * dw, alpha + length * da, z + length * dz
        active = near & ~self.inequality
        active[at[np.flatnonzero(ineq)[w[ineq] > z]]] = True
        every[at] = size * w
        return every, active

    def _dual_active_set(
        self, start: tuple[Vector, Mask], near: Mask
    ) -> tuple[Vector, Vector, Mask]:
        """Return the exact solution for the near rows, from a guess of those that press."""
        active = start[1]
        seen: set[bytes] = set()
        single = False
        for _ in range(200):
            w, alpha = self._equality(active)
            if not self._is_balanced(w):
                raise Unsure("the active rows do not balance the load")
            alpha = alpha + self._away(active, near, self.Phi @ w - self.d - self.A.T @ alpha)
            opening = self.Phi @ w - self.d - self.A.T @ alpha
            drop = self.inequality & active & (w < -1e-12 * float(np.abs(w).max()))
            add = self.inequality & near & ~active & (opening < -self._rounding(w, alpha))
            if not drop.any() and not add.any():
                w = np.where(self.inequality, np.maximum(w, 0.0), w)
                return w, alpha, active
            if active.tobytes() in seen:
                single = True
            seen.add(active.tobytes())
            if single:  # one change at a time, the worst one
                badness = np.where(drop, -w, np.where(add, -opening, 0.0))
                worst = int(np.argmax(badness))
                drop, add = drop & False, add & False
                active = active.copy()
                active[worst] = ~active[worst]
            else:
                active = (active & ~drop) | add
        raise Unsure("the active set method does not end")

    def _is_balanced(self, w: Vector) -> bool:
        size = float(np.abs(self.A).max(initial=0.0) * np.abs(w).sum() + np.abs(self.e).sum())
        return float(np.abs(self.A @ w - self.e).max(initial=0.0)) <= 1e-12 * size

    def _primal_active_set(
        self, start: tuple[Vector, Mask], near: Mask
    ) -> tuple[Vector, Vector, Mask]:
        """Return the exact solution for the near rows by steps that keep A w = e, lambda >= 0."""
        w = start[0]
        if not self._is_balanced(w) or (w[near & self.inequality] <= 0.0).any():
            w = self._carrying(near)
        active = near & (~self.inequality | (w > 0.0))
        for _ in range(600):
            at = np.flatnonzero(active)
            n = at.size
            M = self._saddle(at)
            slope = self.d[at] - self.Phi[at] @ w
            x, left = _symmetric_solve(M, np.append(slope, self.A @ w - self.e))
            p, alpha, full = x[:n], x[n:], 1.0
            if np.linalg.norm(left[:n]) > 1e-10 * np.linalg.norm(slope):
                p, full = left[:n], np.inf  # no curvature this way
            down = np.flatnonzero(self.inequality[at] & (p < 0.0))
            steps = w[at[down]] / -p[down]
            length = min(full, float(steps.min(initial=np.inf)))
            if not np.isfinite(length):
                raise Unsure("the dual is not bounded")
            w = w.copy()
            w[at] += length * p
            if length < full:
                first = at[down[np.argmin(steps)]]
                w[first], active[first] = 0.0, False
                continue
            alpha = alpha + self._away(active, near, self.Phi @ w - self.d - self.A.T @ alpha)
            opening = self.Phi @ w - self.d - self.A.T @ alpha
            closed = np.where(self.inequality & near & ~active, opening, 0.0)
            closed[closed >= -self._rounding(w, alpha)] = 0.0
            worst = int(np.argmin(closed))
            if closed[worst] == 0.0:
                return w, alpha, active
            active[worst] = True
        raise Unsure("the active set method does not end")

    def _rounding(self, w: Vector, alpha: Vector) -> Vector:
        """Return what of the openings of rows may be rounding errors."""
        terms: Vector = (
            np.abs(self.Phi) @ np.abs(w) + np.abs(self.d) + np.abs(self.A.T) @ np.abs(alpha)
        )
        return 1e-12 * terms

    def _carrying(self, near: Mask) -> Vector:
        """Return some w with A w = e and lambda >= 0."""
        at, free = np.flatnonzero(near), np.flatnonzero(~self.inequality)
        signed = np.hstack([self.A[:, at], -self.A[:, free]])
        norm = float(np.linalg.norm(self.e))
        w = np.zeros(self.d.size)
        if norm > 0.0:
            x, _ = nnls(signed, self.e / norm, maxiter=100 * signed.shape[1] + 100)
            w[at] = norm * x[: at.size]
            w[free] -= norm * x[at.size :]
        return w

    def _saddle(self, at: Numbers) -> Vector:
        n, r = at.size, len(self.e)
        M = np.zeros((n + r, n + r))
        M[:n, :n] = self.Phi[np.ix_(at, at)]
        M[:n, n:], M[n:, :n] = -self.A[:, at].T, -self.A[:, at]
        return M

    def _away(self, active: Mask, near: Mask, opening: Vector) -> Vector:
        """Return motions that the active rows leave free, for which the others stay open."""
        free = _null_space(self.A[:, active].T, "active rows") if len(self.A) else self.A[:, :0]
        others = np.flatnonzero(near & ~active)
        if not free.shape[1] or not (opening[others] < 0.0).any():
            return np.zeros(len(self.A))
        move = -self.A[:, others].T @ free
        seen = np.linalg.norm(move, axis=1) > 1e-12
        move, need = move[seen], -opening[others][seen]
        size = float(np.abs(need).max(initial=0.0))
        if size == 0.0:
            return np.zeros(len(self.A))
        E = np.vstack([move.T, need / size])
        target = np.append(np.zeros(free.shape[1]), 1.0)
        x, _ = nnls(E, target, maxiter=100 * E.shape[1] + 100)
        r = E @ x - target
        if np.linalg.norm(r) < 1e-9:
            return np.zeros(len(self.A))
        return free @ (-size * r[:-1] / r[-1])

    def _equality(self, active: Mask) -> tuple[Vector, Vector]:
        """Solve with all active rows closed."""
        at = np.flatnonzero(active)
        x, _ = _symmetric_solve(self._saddle(at), np.concatenate([self.d[at], -self.e]))
        w = np.zeros(self.d.size)
        w[at] = x[: at.size]
        return w, x[at.size :]


def _largest(x: Vector, step: Vector) -> float:
    """Return the largest step for which x stays nonnegative."""
    down = step < 0.0
    return float(np.min(-x[down] / step[down], initial=1.0))


def _symmetric_solve(M: Vector, right: Vector) -> tuple[Vector, Vector]:
    """Solve Mx = right in the range of M, with refinement; return x and the residual."""
    scale = np.ones(len(M))
    for _ in range(5):  # Ruiz
        largest = np.abs(M * scale[:, None] * scale).max(axis=1, initial=0.0)
        scale /= np.sqrt(np.where(largest > 0.0, largest, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * M * scale)
    inverse = np.where(np.abs(values) > _SINGULAR, 1.0 / np.where(values == 0, 1, values), 0.0)
    long = M.astype(np.longdouble)
    x: Vector = np.zeros(len(M))
    left = right
    for _ in range(4):
        x = x + scale * (vectors @ (inverse * (vectors.T @ (scale * left))))
        left = (right - long @ x).astype(float)
    return x, left


# -- the result, measured --------------------------------------------------------------------------


def _measured(whole: _Condensed, w: Vector, alpha: Vector, active: Mask) -> Answer:
    """Recover u and measure the optimality conditions in the energy norm of each body."""
    problem, m = whole.problem, whole.m
    count = len(whole.bodies)
    u = np.zeros(problem.load.size)
    energy, residual = np.zeros(count), np.zeros(count)
    imbalance, sizes = np.zeros(count), np.zeros(count)
    for b, body in enumerate(whole.bodies):
        forces = whole.f[b] - whole.B[b].T @ w
        v = body.solve(forces)
        at = slice(whole.alpha_of[b], whole.alpha_of[b + 1])
        local = body.lift.copy()
        local[body.free] += v
        energy[b] = max(0.0, float(local @ body.full_K @ local))
        left = (forces - body.K.astype(np.longdouble) @ v).astype(float)
        rigid = body.N.T @ left
        sizes[b] = body.forces + (np.abs(whole.B[b].T) @ np.abs(w)).sum()
        imbalance[b] = np.abs(rigid).max(initial=0.0)
        left -= body.N @ rigid
        residual[b] = np.sqrt(max(0.0, float(left @ body.solve(left))))
        local[body.free] += body.N @ alpha[at]
        u[body.unknowns] = local + body.shift
    for bodies, _ in whole._components():
        worst, size = imbalance[bodies].max(), sizes[bodies].max()
        if worst > 1e-12 * size:
            raise Unsure(f"forces of a body out of balance by {worst / size:.1e}")

    # springs, by the displacement itself
    springs, end = problem.springs, whole.end
    stretch = springs.rows @ u
    of_spring = problem.body_of_springs()
    np.add.at(energy, of_spring, springs.stiffness * stretch**2)
    mismatch = np.sqrt(springs.stiffness) * (stretch - w[m:end] / springs.stiffness)
    np.add.at(residual, of_spring, np.abs(np.where(whole.movable[m:end], mismatch, 0.0)))

    # tied rows
    torn = np.abs(problem.tied @ u - problem.tied_jump) * whole.scale[end:]
    for b in range(count):
        residual[b] += float(np.linalg.norm(torn[whole.touched[end:, b] & whole.movable[end:]]))

    # contact rows
    finite = whole.finite
    opening = problem.gap[finite] - problem.rows[finite] @ u
    force = w[:m]
    wrong = np.where(force > 0.0, np.abs(opening), np.maximum(-opening, 0.0)) * whole.scale[:m]
    for b in range(count):
        here = whole.touched[:m, b] & whole.movable[:m]
        residual[b] += float(np.linalg.norm(wrong[here]))

    # bodies that touch without force belong together, too
    touching = (force > 0.0) | (np.abs(opening) <= 1e-12 * np.abs(u).max(initial=0.0))
    pressing = np.vstack([whole.touched[:m][touching], whole.touched[end:]]).astype(float)
    group = connected_components(pressing.T @ pressing, directed=False)[1]
    every = np.zeros(problem.gap.size)
    every[finite] = force
    noise = _noise(whole, u, w, active)
    groups = group.astype(np.int64)
    return Answer("solution", "", u, every, w[end:], energy, groups, noise, residual)


def _noise(whole: _Condensed, u: Vector, w: Vector, active: Mask) -> Vector:
    """Return what one rounding of each number does to the solution, in the bodies' energy norms."""
    problem, rng, m = whole.problem, np.random.default_rng(0), whole.m
    K = abs(problem.elastic) + abs(problem.springs.matrix())
    forces = _EPS * (K @ np.abs(u) + np.abs(problem.load))
    rows = problem.rows[whole.finite]
    lengths = np.zeros(w.size)
    lengths[:m] = abs(rows) @ np.abs(u) + np.abs(problem.gap[whole.finite]) * (w[:m] > 0.0)
    lengths[:m] += problem.gap_rounding[whole.finite] / _EPS
    lengths[whole.end :] = abs(problem.tied) @ np.abs(u) + np.abs(problem.tied_jump)
    parts = [
        _Programme(whole, rows, whole._alphas(bodies))
        for bodies, rows in whole._components()
        if rows.size
    ]
    found = np.zeros(len(whole.bodies))
    for _ in range(3):
        df = forces * rng.choice([-1.0, 1.0], forces.size)
        d = -_EPS * lengths * rng.choice([-1.0, 1.0], lengths.size)
        own = [df[body.unknowns][body.free] for body in whole.bodies]
        for b, body in enumerate(whole.bodies):
            d = d + whole.B[b] @ body.solve(own[b])
        e = np.concatenate(
            [np.zeros(0)] + [B.N.T @ f for B, f in zip(whole.bodies, own, strict=True)]
        )
        dw = np.zeros(w.size)
        for part in parts:
            dw[part.rows] = part.response(d, e, active[part.rows])
        for b, body in enumerate(whole.bodies):
            v = body.solve(own[b] - whole.B[b].T @ dw)
            springs = np.flatnonzero(whole.touched[m : whole.end, b])
            soft = float(np.sum(dw[m:][springs] ** 2 / problem.springs.stiffness[springs]))
            found[b] = max(found[b], np.sqrt(max(0.0, float(v @ body.K @ v)) + soft))
    return found
