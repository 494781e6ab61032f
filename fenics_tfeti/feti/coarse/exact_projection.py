"""The nearest multipliers with Gl = e, l_I >= o and |l_T| <= r, without a product with F.

For given forces b the minimiser of

    1/2 l'Hl - b'l  subject to  Gl = e,  l_I >= o,  |l_T| <= r

in the metric H of `GramMetric` is l = P(S^-2 (b + G'z - Cw)), P the projection on the bounds, with
the rigid motions z and the displacements w = C'l that are the minimiser of a convex function whose
gradient is (Gl - e, w - C'l). Newton's method takes a few solves with G D G' and starts from the
last z and w. Where the bounds cannot hold the load no such l exists: the function has no minimum,
and the motions grow (Farkas' lemma).

On rows without bounds H may be M^-1 of a preconditioner M: there l = b + MG'z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.tolerances import MANY, PARALLEL, rounding
from fenics_tfeti.parallel import concatenate_buffers
from fenics_tfeti.qp import ProductSet
from fenics_tfeti.typing import Numbers, Vector

# eigenvalue of the Gram matrix of unit rows below which they nearly depend on each other, and part
# of a row in the eigenvectors from which on it belongs to their group
_NEARLY_DEPENDENT, _PART = 5e-2, 2e-2
# order of a block of the Gram matrix up to which its eigenvectors are looked for
_LARGEST_BLOCK = 600
# eigenvalue of H where rows of a group depend on each other; F has less, and steps are as long
_LEAST = 1e-4
# limit on Newton steps; |Gl - e| relative to e and |C'l - w| relative to l that are rounding, and
# those that may be if they do not decrease
_STEPS, _EXACT, _ROUNDING = 1000, 1e-12, 1e-8
# G'z relative to b and l that tells of a cost without a minimum; those of minimisers are below 1e2
_UNBOUNDED = 1e6
# slope that ends the line search, relative to the first one, and limit on its evaluations
_SLOPE, _EVALUATIONS = 0.3, 40
# added to the diagonal of Newton's matrix, relative to the diagonal without bounds
_SHIFT = 1e-10
# order of Newton's matrix up to which dense algebra is faster
_DENSE = 300


@dataclass(frozen=True)
class GramMetric:
    """H = S^2 + CC': the Gram matrix of rows that nearly depend on each other, else the identity.

    F makes little of combinations of rows that nearly vanish, as where three bodies meet. The Gram
    matrix W of the rows does so, too. On rows that depend exactly the identity serves as well.
    """

    scale: Vector  # (m,): S
    springs: sp.csr_matrix  # C (m, k)
    constraints: Constraints

    @staticmethod
    def build(constraints: Constraints) -> GramMetric:
        """Find the groups of rows. All ranks have all coupled rows. Collective."""
        coupling, friction = constraints.coupling, constraints.friction
        site = -1.0 - np.arange(coupling.numbers.size)
        if coupling.numbers.size:
            numbers = friction.spread(friction.numbers(constraints.layout) + 1.0, constraints.size)
            given = coupling.gather(numbers)[0]
            site = np.where(coupling.tangential, given, site)
        scale, columns = np.ones(coupling.numbers.size), list[sp.coo_matrix]()
        for group in _nearly_dependent(coupling.gram, np.flatnonzero(~coupling.tied)):
            rows = np.flatnonzero(np.isin(site, site[group]) & ~coupling.tied)
            rows = rows[scale[rows] == 1.0]
            values, vectors = np.linalg.eigh(coupling.gram[rows][:, rows].toarray())
            kept = values > PARALLEL
            C = vectors[:, kept] * np.sqrt(values[kept])
            where = np.repeat(rows, C.shape[1]), np.tile(np.arange(C.shape[1]), rows.size)
            columns.append(sp.coo_matrix((C.ravel(), where), (scale.size, C.shape[1])))
            scale[rows] = np.sqrt(_LEAST)
        here, size = coupling.rows, constraints.size
        whole = sp.hstack([sp.csr_matrix((scale.size, 0)), *columns], format="csr")
        places = (np.ones(here.size), (here, coupling.positions))
        on_rows = np.ones(size)
        on_rows[here] = scale[coupling.positions]
        springs = sp.csr_matrix(places, (size, scale.size)) @ whole
        return GramMetric(on_rows, springs.tocsr(), constraints)

    def stretch(self, x: Vector) -> Vector:
        """Return C'x. Collective."""
        owned = self.constraints.layout.owned
        part = self.springs[:owned].T @ x[:owned]
        return self.constraints.layout.space.sum_over_ranks(part) if part.size else part

    def __call__(self, x: Vector) -> Vector:
        """Return Hx. Collective."""
        product: Vector = self.scale**2 * x + self.springs @ self.stretch(x)
        return product


def _nearly_dependent(W: sp.csr_matrix, chosen: Numbers) -> list[Numbers]:
    """Return groups of rows of a Gram matrix that nearly, but not exactly, depend on each other."""
    groups = list[Numbers]()
    if not chosen.size:
        return groups
    block = connected_components(W[chosen][:, chosen], directed=False)[1]
    order = np.argsort(block, kind="stable")
    for local in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
        rows = chosen[local]
        if not 1 < rows.size <= _LARGEST_BLOCK:
            continue
        values, vectors = np.linalg.eigh(W[rows][:, rows].toarray())
        weak = vectors[:, (values > PARALLEL) & (values < _NEARLY_DEPENDENT)]
        if not weak.shape[1]:
            continue
        count, group = connected_components(np.abs(weak @ weak.T) > _PART, directed=False)
        groups += [rows[group == g] for g in range(count) if np.count_nonzero(group == g) > 1]
    return groups


@dataclass
class ExactProjection:
    """The minimiser of 1/2 l'Hl - b'l, with the motions and displacements of the last one.

    With a preconditioner b has M times the forces on rows without bounds.
    """

    coarse_space: CoarseSpace
    e: Vector  # (coarse,)
    metric: GramMetric
    # x -> Mx of rows without bounds, x of others; None for x of all rows
    preconditioner: Callable[[Vector], Vector] | None = None
    # A (m, coarse + k): G' and -C on rows with bounds, for the coarse unknowns of all ranks
    _closing: sp.csr_matrix = field(init=False, repr=False)
    _linear: sp.csr_matrix = field(init=False, repr=False)  # GG' of equality rows, I for w
    _unit: Vector = field(init=False, repr=False)  # (coarse + k,): makes the diagonal 1
    motion: Vector = field(init=False, repr=False)  # (coarse + k,): z and w
    balanced: bool = field(init=False, default=True)  # whether the last one has Gl = e

    def __post_init__(self) -> None:
        """Put the matrices together. Collective."""
        space, constraints = self.coarse_space, self.coarse_space.constraints
        k = self.metric.springs.shape[1]
        inequality = constraints.inequality
        places = (np.ones(inequality.size), (inequality, np.arange(inequality.size)))
        of_contact = sp.csr_matrix(places, (constraints.size, inequality.size))
        bounded = of_contact @ space.contact.T + space.friction.T
        scaled = sp.diags(1.0 / self.metric.scale)
        self._closing = (scaled @ sp.hstack([bounded, -self.metric.springs])).tocsr()
        linear = _whole(space)
        if self.preconditioner is not None:
            linear = _preconditioned(space, linear, self.preconditioner)
        self._linear = sp.block_diag([linear, sp.identity(k)], format="csr")
        self.motion = np.zeros(space.size + k)
        owned = self._closing[: constraints.layout.owned]
        squares = np.asarray(owned.multiply(owned).sum(axis=0)).ravel()
        diagonal = constraints.layout.space.sum_over_ranks(squares) + self._linear.diagonal()
        self._unit = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))

    def __call__(self, b: Vector, radius: Vector) -> Vector:
        """Return l (m,), feasible in any case; see `balanced`. Collective."""
        evaluate = self._evaluation(b, radius)
        motion, last = self.motion.copy(), np.inf
        state = evaluate(motion)
        for _ in range(_STEPS):
            size = state.error
            rounded = size <= _ROUNDING and size > 0.5 * last
            if size <= _EXACT or rounded or state.pull > _UNBOUNDED:
                break
            last = size
            step = self._newton_step(state)
            t, state = _least(evaluate, motion, step, state)
            motion = motion + t * step
        self.motion = motion
        self.balanced = state.error <= _ROUNDING
        return state.multipliers

    def pull(self) -> Vector:
        """Return G'z (m,) of the last minimiser. Collective."""
        return self.coarse_space.prolong(self.motion[: self.coarse_space.size])

    def _evaluation(self, b: Vector, radius: Vector) -> Callable[[Vector], _State]:
        """Return (z, w) -> multipliers and gradient."""
        space, metric, n = self.coarse_space, self.metric, self.coarse_space.size
        constraints, friction = space.constraints, space.constraints.friction
        # a whole site has one scale
        at_sites = np.min(np.where(friction.present, metric.scale[friction.rows], 1.0), axis=1)
        feasible = friction.multiplier_set(
            constraints.inequality, np.zeros_like(b), at_sites * radius
        )
        largest = float(np.abs(self.e).max(initial=0.0)) or 1.0

        def evaluate(motion: Vector) -> _State:
            pulled = space.prolong(motion[:n])
            if self.preconditioner is not None:
                pulled = self.preconditioner(pulled)
            forces = b + pulled - metric.springs @ motion[n:]
            unbounded = forces / metric.scale
            l = feasible.project(unbounded.copy()) / metric.scale
            missing, left = self.e - space.restrict(l), metric.stretch(l) - motion[n:]
            squares = constraints.layout.space.dots((l, l), (b, b), (pulled, pulled))
            size, given, pull = (float(np.sqrt(square)) for square in squares)
            # forces that are much larger than the load may cancel up to rounding
            whole = largest + rounding(max(given, pull), MANY) / _ROUNDING
            error = np.abs(missing).max(initial=0.0) / whole
            error = max(float(error), float(np.abs(left).max(initial=0.0)) / (size or 1.0))
            pull /= max(size, given) or 1.0
            return _State(l, unbounded, feasible, np.concatenate([missing, left]), error, pull)

        return evaluate

    def _newton_step(self, state: _State) -> Vector:
        """Return the step for the derivative of P at a state. Collective."""
        owned = self.coarse_space.constraints.layout.owned
        D = state.feasible.derivative(state.unbounded)[:owned, :owned]
        rows = self._closing[:owned]
        H = self._linear + sum_sparse(self.coarse_space.comm, (rows.T @ D @ rows).tocsr())
        # motions of bodies and displacements of rows have sizes of their own
        unit = sp.diags(self._unit)
        H = unit @ H @ unit + _SHIFT * sp.identity(H.shape[0])
        right = self._unit * state.residual
        if H.shape[0] <= _DENSE:
            factor = scipy.linalg.cho_factor(H.toarray())
            return self._unit * scipy.linalg.cho_solve(factor, right)
        symmetric = {"SymmetricMode": True}
        lu = splu(H.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        return np.asarray(self._unit * lu.solve(right))


@dataclass(frozen=True)
class _State:
    """Multipliers of rigid motions z and displacements w."""

    multipliers: Vector  # (m,): l
    unbounded: Vector  # (m,): what P was applied to, scaled by S
    feasible: ProductSet  # of S l
    residual: Vector  # (coarse + k,): e - Gl and C'l - w
    error: float  # its size, relative to e and l
    pull: float  # size of G'z, relative to b and l


def _least(
    evaluate: Callable[[Vector], _State], motion: Vector, step: Vector, state: _State
) -> tuple[float, _State]:
    """Return t and the state at motion + t step where the cost is nearly the least.

    The slope decreases with t; its root is found by false position.
    """
    first = float(state.residual @ step)
    low, high, at_low, at_high, t = 0.0, np.inf, first, -np.inf, 1.0
    for _ in range(_EVALUATIONS):
        following = evaluate(motion + t * step)
        slope = float(following.residual @ step)
        if abs(slope) <= _SLOPE * first:
            break
        if slope > 0.0:
            low, at_low = t, slope
        else:
            high, at_high = t, slope
        if np.isinf(high):
            # short of where the load is balanced
            t *= 2.0
        else:
            part = at_low / (at_low - at_high)
            t = low + float(np.clip(part, 0.1, 0.9)) * (high - low)
    return t, following


def _preconditioned(
    space: CoarseSpace, equality: sp.csr_matrix, preconditioner: Callable[[Vector], Vector]
) -> sp.csr_matrix:
    """Return GMG' of the equality rows, of which GG' is given, whole on every rank. Collective."""
    rows, chosen = space.constraints.equality, np.flatnonzero(equality.diagonal())
    columns = np.zeros((space.size, chosen.size))
    for column, k in zip(columns.T, chosen.tolist(), strict=True):
        unit, glued = np.zeros(space.size), np.zeros(space.constraints.size)
        unit[k] = 1.0
        glued[rows] = space.prolong(unit)[rows]
        column[:] = space.restrict(preconditioner(glued))
    where = np.repeat(np.arange(space.size), chosen.size), np.tile(chosen, space.size)
    whole = sp.csr_matrix((columns.ravel(), where), shape=equality.shape)
    whole.eliminate_zeros()
    return 0.5 * (whole + whole.T)


def _whole(space: CoarseSpace) -> sp.csr_matrix:
    """Return GG' of the equality rows, whole on every rank. Collective."""
    layout = space.layout
    if not layout.by_rows or space.comm.size == 1:
        return space.equality
    coo = space.equality.tocoo()
    row, column, data = concatenate_buffers(
        space.comm, coo.row.astype(np.int64) + layout.first, coo.col.astype(np.int64), coo.data
    )
    return sp.csr_matrix((data, (row, column)), shape=(space.size, space.size))
