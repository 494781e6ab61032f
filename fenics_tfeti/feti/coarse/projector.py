"""Projector preconditioning: Q onto the natural coarse space Im G' and P onto Ker G (sec. 11.8).

The rows of G are those of the equality constraints, of some contact rows and of some tangential
rows: of all of them for the dual problem, for a face of it of the active ones and those that stick.
Where a site of friction slips, the combination of its rows across its force may be added.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.factor import CoarseFactor
from fenics_tfeti.feti.coarse.inverse import InverseByRows
from fenics_tfeti.feti.coarse.recent import RecentFaces
from fenics_tfeti.feti.coarse.resistance import of_one_body, orthonormal_columns, pivot_rows
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.tolerances import NO_WORK
from fenics_tfeti.typing import Mask, Vector

# factor on the diagonal of GG' for pinned motions that are weakly resisted
_FIRMLY = 1e8
# work of the load on a free motion, relative to the load of all bodies, that is rounding
_CARRIED = 1e-14
# error of one application of P up to which it is accurate, and limit on the applications
_ACCURATE, _MOST_PASSES = 1e-11, 4


@dataclass(frozen=True)
class WeakMotions:
    """Motions that the rows resist so weakly that GG', which squares G, does not show it.

    They are pinned in the factored matrix A, and return as a correction of its inverse:
    (GG')^+ = A^{-1} + Z Z' and Q = G'A^{-1}G + W W'.

    Attributes
    ----------
    motions : (coarse, k) array
        Z.
    rows : (m, k) array
        W = G'Z on all rows that this rank holds; on the projector's rows orthonormal.
    """

    motions: Vector
    rows: Vector


@dataclass(frozen=True)
class Projector:
    """Q = G'(GG')^+ G and P = I - Q for the equality rows and some contact and tangential rows.

    Attributes
    ----------
    coarse_space : CoarseSpace
        G.
    rows : (m,) bool array
        The rows of B that are meant; all others of a multiplier count as zero.
    free : (coarse, k) scipy.sparse.csr_matrix
        Orthonormal basis of the kernel of GG': rigid motions that these rows do not resist.
    free_bodies : (modes * bodies, k) scipy.sparse.csr_matrix
        The same as motions of bodies, see `BodyMotions`.
    factor : CoarseFactor or None
        That of GG'; None where no subdomain can move.
    weak : WeakMotions or None
        Motions that are resisted too weakly for the factor.
    across : (k, gdim - 1) array or None
        Unit vectors at sites of friction, zero at most: the combinations of their rows that are
        meant as well.
    passes : int
        Applications of P, one after the other, that make it accurate.
    """

    coarse_space: CoarseSpace
    rows: Mask
    free: sp.csr_matrix
    free_bodies: sp.csr_matrix
    factor: CoarseFactor | None
    weak: WeakMotions | None = None
    across: Vector | None = None
    passes: int = 1

    @staticmethod
    def build(
        coarse_space: CoarseSpace,
        active: Mask | None = None,
        sticking: Mask | None = None,
        across: Vector | None = None,
    ) -> Projector:
        """Factor GG' of the equality rows and the chosen others. Collective.

        Parameters
        ----------
        coarse_space : CoarseSpace
            G.
        active : (i,) bool array, optional
            The contact rows; by default all of them and all tangential rows.
        sticking : (k,) bool array, optional
            The sites of friction whose tangential rows are meant; none by default, if contact rows
            are given.
        across : (k, gdim - 1) array, optional
            Unit vectors at sites that do not stick, zero at others: combinations of their rows.
        """
        constraints = coarse_space.constraints
        everything = active is None
        chosen = np.ones(constraints.inequality.size, dtype=bool) if active is None else active
        if sticking is None:
            sticking = np.full(constraints.friction.size, everything)
        rows = constraints.face(chosen, sticking)
        known = coarse_space.recent.find(rows, across)
        if known is not None:
            projector: Projector = known(coarse_space)
            return projector
        return Projector._factored(coarse_space, rows, across, everything)

    @staticmethod
    def _factored(
        coarse_space: CoarseSpace, rows: Mask, across: Vector | None, everything: bool
    ) -> Projector:
        """Factor GG' of some rows, or of all of them, and keep the factor for a while."""
        constraints = coarse_space.constraints
        combined = None if across is None else constraints.friction.combined(across, rows.size)
        own = (
            None
            if combined is None
            else combined[constraints.friction.owned(constraints.layout.owned)]
        )
        z, weak = coarse_space.weakly_resisted(rows, combinations=own)
        alone = of_one_body(z.tocsc(), coarse_space.bodies.modes)
        moves = coarse_space.coarse_motions(z)
        free = orthonormal_columns(moves[:, alone], moves[:, ~alone])
        columns = _columns(coarse_space, rows, combined)
        layout = coarse_space.layout
        gram = coarse_space.equality + layout.rows((columns[layout.own] @ columns.T).tocsr())
        pins = np.zeros(layout.size)
        if free.shape[1] + weak.shape[1]:
            single, others = np.split(np.arange(free.shape[1]), [np.count_nonzero(alone)])
            pinned = pivot_rows(
                free[:, single],
                sp.hstack([free[:, others], coarse_space.coarse_motions(weak)], format="csr"),
            )
            # the matrix is definite then, and for right-hand sides without a part in `free` the
            # pinned unknowns are zero: its inverse is a generalized inverse of GG'
            pins[pinned] = _pin(coarse_space, gram, bool(weak.shape[1]))
        factor: CoarseFactor | None = None
        if layout.size and layout.solver == "inverse":
            if everything:
                inverse = InverseByRows.build(layout, gram, pins)
                recent: RecentFaces[Any] = RecentFaces(coarse_space.comm)
                coarse_space = replace(coarse_space, inverse=inverse, recent=recent)
            factor = _changed_inverse(coarse_space, gram, rows, combined, pins)
        elif layout.size:
            factor = layout.factor(layout.add_to_diagonal(gram, pins))
        of_face = partial(
            Projector, rows=rows, free=free, free_bodies=z, factor=factor, across=across
        )
        if weak.shape[1]:
            of_face = partial(of_face, weak=of_face(coarse_space)._weak_motions(weak.toarray()))
        of_face = partial(of_face, passes=of_face(coarse_space)._passes())
        coarse_space.recent.keep(rows, across, of_face)
        return of_face(coarse_space)

    def _weak_motions(self, z: Vector) -> WeakMotions:
        """Return how motions z of bodies, which the factor pins, correct its inverse."""
        coarse_space, space = self.coarse_space, self.coarse_space.constraints.layout.space
        # Z = (I - A^{-1} GG') T z, W = G'Z; what T z does to the rows is known without rounding
        moved = coarse_space.moved_rows(z)
        follow = np.column_stack([self.coefficients(column) for column in moved.T])
        W = moved - np.column_stack([coarse_space.prolong(column) for column in follow.T])
        own = np.column_stack([self.on_rows(column) for column in W.T])
        own = own[: coarse_space.constraints.layout.owned]
        gram = space.sum_over_ranks(own.T @ own)
        # Z and W times V S^{-1/2} with W'W = VSV'; motions that only springs resist move no row
        squares, V = np.linalg.eigh(gram)
        moving = squares > np.finfo(float).eps * squares.max(initial=0.0)
        inverse = V[:, moving] / np.sqrt(squares[moving])
        return WeakMotions((coarse_space.coarse_motions(z) - follow) @ inverse, W @ inverse)

    def _passes(self) -> int:
        """Return how many applications make P accurate, by the error of one. Collective.

        Where stiff subdomains hang on soft ones, the weights of the rows differ as the materials
        do, and GG', which squares them, resists motions of all stiff subdomains together by its
        last digits. Px then has a part Q P x that P has to remove once more; each pass reduces it
        by the same factor.
        """
        if self.factor is None:
            return 1
        layout = self.coarse_space.constraints.layout
        x = self.on_rows(seeded_vector(layout.numbers))
        left = self.Q(self.P(x))
        squares = layout.space.dots((x, x), (left, left))
        error = float(np.sqrt(squares[1] / (squares[0] or 1.0)))
        passes = 1
        while passes < _MOST_PASSES and error**passes > _ACCURATE:
            passes += 1
        return passes

    # -- coarse vectors that every rank has whole -------------------------------------------------

    def solve(self, coarse: Vector) -> Vector:
        """Return (GG')^+ applied to a coarse vector in the range of G."""
        if self.factor is None:
            return coarse
        solution = self.factor.solve(coarse)
        if self.weak is not None:
            solution = solution + self.weak.motions @ (self.weak.motions.T @ coarse)
        return solution

    def without_free_motions(self, coarse: Vector) -> Vector:
        """Return a coarse vector without its part in the motions that the rows do not resist."""
        part: Vector = coarse - self.free @ (self.free.T @ coarse)
        return part

    def unresisted(self, e: Vector, size: Vector) -> Vector:
        """Return the part of a coarse load that does work on motions that the rows do not resist.

        It is zero for bodies where it is rounding of their own load.

        Parameters
        ----------
        e : (coarse,) array
            R'f.
        size : (coarse,) array
            |R|'|f|.
        """
        part: Vector = self.free @ (self.free.T @ e)
        if not part.any():
            return part
        body = self.coarse_space.bodies.of_coarse
        work, load = (np.sqrt(np.bincount(body, x**2)) for x in (part, size))
        # free motions are known up to rounding, which is carried from one body to another
        free = np.sqrt(np.bincount(body, np.asarray(self.free.power(2).sum(axis=1)).ravel()))
        negligible = work <= NO_WORK * load + _CARRIED * free * np.linalg.norm(size)
        part[negligible[body]] = 0.0
        return part

    def coefficients(self, x: Vector) -> Vector:
        """Return (GG')^+ G x."""
        solution = self._coefficients(x)
        for _ in range(1, self.passes):
            solution = solution + self._coefficients(x - self.coarse_space.prolong(solution))
        return solution

    def _coefficients(self, x: Vector) -> Vector:
        coarse = self.coarse_space.restrict(self.on_rows(x))
        if self.factor is None:
            return coarse
        solution = self.factor.solve(coarse)
        if self.weak is not None:
            solution = solution + self.weak.motions @ self._weak_part(x)
        return solution

    def expand(self, coarse: Vector) -> Vector:
        """Return G' applied to a coarse vector."""
        return self.on_rows(self.coarse_space.prolong(coarse))

    def least_norm(self, coarse: Vector) -> Vector:
        """Return G'(GG')^+ applied to a coarse vector: the smallest x on the rows with Gx = it."""
        x = self._least_norm(coarse)
        for _ in range(1, self.passes):
            missing = self.without_free_motions(coarse - self.coarse_space.restrict(x))
            x = x + self._least_norm(missing)
        return x

    def _least_norm(self, coarse: Vector) -> Vector:
        if self.factor is None:
            return self.expand(coarse)
        x = self.coarse_space.prolong(self.factor.solve(coarse))
        if self.weak is not None:
            x = x + self.weak.rows @ (self.weak.motions.T @ coarse)
        return self.on_rows(x)

    def _weak_part(self, x: Vector) -> Vector:
        """Return W'x."""
        assert self.weak is not None
        layout = self.coarse_space.constraints.layout
        part = self.weak.rows[: layout.owned].T @ self.on_rows(x)[: layout.owned]
        return layout.space.sum_over_ranks(part)

    # -- multipliers ------------------------------------------------------------------------------

    def on_rows(self, x: Vector) -> Vector:
        """Return x with zeros outside the rows, but for the combinations across."""
        chosen = np.where(self.rows, x, 0.0)
        if self.across is not None:
            friction = self.coarse_space.constraints.friction
            size = np.sum(friction.at_sites(x) * self.across, axis=1, keepdims=True)
            chosen[friction.flat] += (size * self.across)[friction.present]
        return chosen

    def Q(self, x: Vector) -> Vector:
        """Return Qx = G'(GG')^+ Gx."""
        Qx = self._Q(x)
        for _ in range(1, self.passes):
            Qx = Qx + self._Q(x - Qx)
        return Qx

    def _Q(self, x: Vector) -> Vector:
        if self.factor is None or self.weak is None:
            return self.expand(self._coefficients(x))
        coarse = self.factor.solve(self.coarse_space.restrict(self.on_rows(x)))
        motion = self.coarse_space.prolong(coarse) + self.weak.rows @ self._weak_part(x)
        return self.on_rows(motion)

    def P(self, x: Vector) -> Vector:
        """Return Px = x - Qx."""
        return x - self.Q(x)

    # -- sums of the ranks' parts, with one exchange of multipliers or none ------------------------

    def P_of_sum(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return Py on the rows and x'y, where y is the sum of the ranks' parts; one exchange."""
        motion, xy = self._own_motion(part, x)
        return self._refined(self._sum(self.on_rows(part - motion))), xy

    def part_of_P(self, part: Vector) -> Vector:
        """Return this rank's part of Py on the rows, where y is the sum of the ranks' parts."""
        rest = self.on_rows(part - self._own_motion(part)[0])
        if self.passes == 1:
            return rest
        return self.coarse_space.constraints.layout.owned_part(self._refined(self._sum(rest)))

    def part_of_Q(self, x: Vector) -> tuple[Vector, Vector]:
        """Return this rank's part of Qx, and Qx itself without an exchange of multipliers.

        The latter is not bitwise the same on all ranks that hold a component: good for products
        that are summed, not for what is compared with bounds.
        """
        if self.factor is None:
            return np.zeros_like(x), np.zeros_like(x)
        part, Qx = self._part_of_Q(x)
        if self.passes == 1:
            return part, Qx
        Qx = x - self._refined(x - self._sum(part))
        return self.coarse_space.constraints.layout.owned_part(Qx), Qx

    def _part_of_Q(self, x: Vector) -> tuple[Vector, Vector]:
        assert self.factor is not None
        own, others = self.factor.solve_own(self.coarse_space.restrict_own(self.on_rows(x)))
        part = self.on_rows(self.coarse_space.prolong_own(own))
        Qx = part + self.on_rows(self.coarse_space.others.T @ others)
        if self.weak is not None:
            weak = self.on_rows(self.weak.rows @ self._weak_part(x))
            part, Qx = part + self.coarse_space.constraints.layout.owned_part(weak), Qx + weak
        return part, Qx

    def remove_rigid_motion(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return y - G'a with the rigid motions a = (GG')^+ Gy, and x'y; one exchange.

        On the rows this is Py; on the other rows it is what the motions do there. The motions that
        the rows do not resist are left out of a.

        Parameters
        ----------
        part : (m,) array
            This rank's part of y.
        x : (m,) array
            A vector whose inner product with y is wanted; it is summed along with Gy.
        """
        motion, xy = self._own_motion(part, x, resisted=True)
        return self._refined(self._sum(part - motion), off_the_rows=True), xy

    def _refined(self, y: Vector, off_the_rows: bool = False) -> Vector:
        """Return y after the other applications of P; each is an exchange.

        They need the sum of the ranks' parts: these have rigid motions that cancel each other.
        """
        layout = self.coarse_space.constraints.layout
        for _ in range(1, self.passes):
            motion = self._own_motion(layout.owned_part(y), resisted=off_the_rows)[0]
            y = y - self._sum(motion if off_the_rows else self.on_rows(motion))
        return y

    def _own_motion(
        self, part: Vector, x: Vector | None = None, resisted: bool = False
    ) -> tuple[Vector, float]:
        """Return what this rank's subdomains add to G'(GG')^+ Gy, and x'y (zero without x)."""
        sum_over_ranks = self.coarse_space.constraints.layout.space.sum_over_ranks
        # all holders of a component have the same of x, so each may multiply its part of y
        numbers = np.zeros(0) if x is None else np.array([x @ part])
        if self.factor is None:
            return np.zeros_like(part), float(sum_over_ranks(numbers).sum())
        chosen = self.on_rows(part)
        if self.weak is not None:
            numbers = np.append(self.weak.rows.T @ chosen, numbers)
        own, numbers = self.factor.solve_sum(
            self.coarse_space.restrict_own(chosen), self.coarse_space.others @ chosen, numbers
        )
        if resisted and self.free.shape[1]:
            free = self.coarse_space.own_part(self.free)
            own = own - free @ sum_over_ranks(free.T @ own)
        motion = self.coarse_space.prolong_own(own)
        if self.weak is not None:
            k = self.weak.rows.shape[1]
            layout = self.coarse_space.constraints.layout
            motion = motion + layout.owned_part(self.weak.rows @ numbers[:k])
            numbers = numbers[k:]
        return motion, float(numbers.sum())

    def _sum(self, part: Vector) -> Vector:
        return self.coarse_space.constraints.layout.sum(part)


def _columns(
    coarse_space: CoarseSpace, rows: Mask, combined: sp.csr_matrix | None, owned: bool = False
) -> sp.csr_matrix:
    """Return the columns of G of contact and tangential rows, and of combinations of the latter.

    They are all that this rank holds, or those that it owns.
    """
    constraints = coarse_space.constraints
    if owned:
        rows = rows & (np.arange(rows.size) < constraints.layout.owned)
    columns = [coarse_space.contact[:, np.flatnonzero(rows[constraints.inequality])]]
    if constraints.friction.size:
        columns.append(coarse_space.friction[:, np.flatnonzero(rows & ~constraints.equality)])
    if combined is not None:
        mine = constraints.friction.owned(constraints.layout.owned) if owned else slice(None)
        columns.append(coarse_space.friction @ combined[mine].T)
    return sp.hstack(columns, format="csr")


def _changed_inverse(
    coarse_space: CoarseSpace,
    gram: sp.csr_matrix,
    rows: Mask,
    combined: sp.csr_matrix | None,
    pins: Vector,
) -> InverseByRows:
    """Return the inverse of GG' of a face, as a change of that of all rows. Collective."""
    assert coarse_space.inverse is not None, "the projector of all rows is built first"
    removed = _columns(coarse_space, ~rows & ~coarse_space.constraints.equality, None, owned=True)
    nothing = np.zeros_like(rows)
    added = _columns(coarse_space, nothing, combined, owned=True)
    return coarse_space.inverse.changed(gram, removed, added, pins)


def _pin(coarse_space: CoarseSpace, gram: sp.csr_matrix, weak: bool) -> float:
    """Return what to add to the diagonal of GG' for a motion that is pinned.

    Weak motions are pinned so firmly that what resists them is rounding beside it. That is
    relative to rows that resist fully: perhaps no row of GG' does.
    """
    largest: float = coarse_space.layout.largest_diagonal(gram)
    row: float = coarse_space.longest_row**2
    if weak:
        return _FIRMLY * max(largest, row)
    return max(largest, float(np.finfo(float).eps) * row) or 1.0
