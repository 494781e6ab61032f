"""Projector preconditioning: Q onto the natural coarse space Im G' and P onto Ker G (sec. 11.8).

The rows of G are those of a face: the equality rows, some contact and tangential rows, and the
combinations of rows across forces that turn. For the dual problem they are all rows.

Springs that are much softer than nodes would be opened out of all proportion by forces that remove
rigid motions. As far as other rows resist these, they are left to them: with the rows h of G_h and
the soft ones s, P r = r - G'(G_h G_h')^{-1} G_h r on residuals and P'z, which changes z_h alone, on
directions. Both have G P'z = o.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.column_groups import of_one_body, orthonormal_columns
from fenics_tfeti.feti.coarse.gram import GramInverse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.dual_layout import seeded_vector
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.tolerances import FEW, ZERO, rounding
from fenics_tfeti.parallel import any_rank
from fenics_tfeti.typing import Mask, Vector

# error of one application of P up to which it is accurate, and limit on the applications
_ACCURATE, _MOST_PASSES = 1e-11, 4


@dataclass(frozen=True)
class Projector:
    """Q = G'(GG')^+ G and P = I - Q of a face; what is off it counts as zero."""

    coarse_space: CoarseSpace
    face: Face
    held: Face  # without the soft springs
    soft: Mask | None  # (m,): the rows of soft springs; None, on all ranks, without any
    free: sp.csr_matrix  # (coarse, k): orthonormal kernel of GG', motions these rows do not resist
    free_bodies: sp.csr_matrix  # (modes * bodies, k): the same, see `BodyMotions`
    gram: GramInverse  # (GG')^+
    passes: int = 1  # applications of P, one after the other, that make it accurate

    @staticmethod
    def build(coarse_space: CoarseSpace, face: Face) -> Projector:
        """Factor GG' of the rows of a face. Collective."""
        held, soft = _without_soft_springs(coarse_space, face)
        known = coarse_space.faces.find(held)
        if known is not None:
            return Projector(coarse_space, face, held, soft, **known)
        coarse_space.faces.drop_oldest()
        resistance = coarse_space.resistance(held)
        z = resistance.free
        free, single = _orthonormal_motions(coarse_space, z)
        gram = GramInverse.build(coarse_space, held, free, single, resistance.resisted)
        projector = Projector(coarse_space, face, held, soft, free, z, gram)
        projector = replace(projector, passes=projector._passes())
        # without the coarse space, which owns the cache: no cycle keeps the factors in memory
        kept = {k: getattr(projector, k) for k in ("free", "free_bodies", "gram", "passes")}
        coarse_space.faces.keep(held, kept)
        return projector

    def _passes(self) -> int:
        """Return how many applications make P accurate, by the error of one. Collective.

        Where stiff subdomains hang on soft ones, the weights of the rows differ as the materials
        do, and GG', which squares them, resists motions of all stiff subdomains together by its
        last digits. Px then has a part Q P x that P has to remove once more; each pass reduces it
        by the same factor.
        """
        layout = self.coarse_space.constraints.layout
        x = self.held.part(seeded_vector(layout.numbers))
        left = self.Q(self.P(x))
        squares = layout.space.dots((x, x), (left, left))
        error = float(np.sqrt(squares[1] / (squares[0] or 1.0)))
        passes = 1
        while passes < _MOST_PASSES and error**passes > _ACCURATE:
            passes += 1
        return passes

    # -- coarse vectors that every rank has whole -------------------------------------------------

    def without_free_motions(self, coarse: Vector) -> Vector:
        """Return a coarse vector without its part in the motions that the rows do not resist."""
        if not self.free.shape[1]:
            return coarse
        return coarse - self.free @ (self.free.T @ coarse)

    def unresisted(self, e: Vector, size: Vector) -> Vector:
        """Return the part of a coarse load that does work on motions that the rows do not resist.

        The load is e = R'f and its size |R|'|f|, (coarse,). The part is zero for bodies where it is
        rounding of their own load.
        """
        part: Vector = self.free @ (self.free.T @ e)
        if not part.any():
            return part
        body = self.coarse_space.bodies.of_coarse
        work, load = (np.sqrt(np.bincount(body, x**2)) for x in (part, size))
        # free motions are known up to rounding, which is carried from one body to another
        free = np.sqrt(np.bincount(body, np.asarray(self.free.power(2).sum(axis=1)).ravel()))
        negligible = work <= ZERO * load + rounding(free * np.linalg.norm(size), FEW)
        part[negligible[body]] = 0.0
        return part

    def coefficients(self, x: Vector) -> Vector:
        """Return (GG')^+ G x, without a part in the free motions."""
        return self._repeated(self._coefficients, x, self.coarse_space.prolong)

    def _coefficients(self, x: Vector) -> Vector:
        x = self.held.part(x)
        weak: Vector = self.gram.motions @ self.gram.weak_part(x)
        solution = self.gram.factor.solve(self.coarse_space.restrict(x)) + weak
        return self.without_free_motions(solution)

    def least_norm(self, coarse: Vector) -> Vector:
        """Return G'(GG')^+ applied to a coarse vector: the smallest x on the rows with Gx = it.

        Its part in the free motions is left out.
        """
        return self._repeated(self._least_norm, coarse, self.coarse_space.restrict)

    def _least_norm(self, coarse: Vector) -> Vector:
        coarse = self.without_free_motions(coarse)
        weak = self.gram.rows @ (self.gram.motions.T @ coarse)
        return self.held.part(self.coarse_space.prolong(self.gram.factor.solve(coarse)) + weak)

    def _repeated(
        self,
        solve: Callable[[Vector], Vector],
        right: Vector,
        product: Callable[[Vector], Vector],
    ) -> Vector:
        """Return the solution for a right-hand side, with all passes."""
        x = solve(right)
        for _ in range(1, self.passes):
            x = x + solve(right - product(x))
        return x

    # -- multipliers ------------------------------------------------------------------------------

    def Q(self, x: Vector) -> Vector:
        """Return Qx = G'(GG')^+ Gx."""
        return self._sum(self.part_of_Q(x)[0])

    def P(self, x: Vector) -> Vector:
        """Return Px = x - Qx."""
        return x - self.Q(x)

    # -- sums of the ranks' parts, with one exchange of multipliers or none ------------------------

    def P_of_sum(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return P'y on the rows and x'y, where y is the sum of the ranks' parts; one exchange."""
        motion, xy = self._own_motion(part, x)
        held = self._refined(self._sum(self.held.part(part - motion)))
        if self.soft is None:
            return held, xy
        soft = self._sum(np.where(self.soft, part, 0.0))
        return held + soft - self.least_norm(self.coarse_space.restrict(soft)), xy

    def part_of_P(self, part: Vector) -> Vector:
        """Return this rank's part of Py on the rows, where y is the sum of the ranks' parts."""
        rest = self.held.part(part - self._own_motion(part)[0])
        if self.passes == 1:
            return rest
        return self.coarse_space.constraints.layout.owned_part(self._refined(self._sum(rest)))

    def part_of_Q(self, x: Vector) -> tuple[Vector, Vector]:
        """Return this rank's part of Qx, and Qx itself without an exchange of multipliers.

        The latter is not bitwise the same on all ranks that hold a component: good for products
        that are summed, not for what is compared with bounds.
        """
        part, Qx = self._part_of_Q(x)
        if self.passes == 1:
            return part, Qx
        Qx = x - self._refined(x - self._sum(part))
        return self.coarse_space.constraints.layout.owned_part(Qx), Qx

    def _part_of_Q(self, x: Vector) -> tuple[Vector, Vector]:
        coarse_space, x = self.coarse_space, self.held.part(x)
        own, others = self.gram.factor.solve_own(coarse_space.restrict_own(x))
        part = self.held.part(coarse_space.prolong_own(own))
        weak = self.held.part(self.gram.rows @ self.gram.weak_part(x))
        Qx = part + self.held.part(coarse_space.others_transposed @ others) + weak
        return part + coarse_space.constraints.layout.owned_part(weak), Qx

    def remove_rigid_motion(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return y - G'a with the rigid motions a = (GG')^+ Gy, and x'y; one exchange.

        On the rows this is Py; on the other rows it is what the motions do there. The motions that
        the rows do not resist are left out of a. `part` is this rank's part of y (m,); x'y is
        summed along with Gy.
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
            y = y - self._sum(motion if off_the_rows else self.held.part(motion))
        return y

    def _own_motion(
        self, part: Vector, x: Vector | None = None, resisted: bool = False
    ) -> tuple[Vector, float]:
        """Return what this rank's subdomains add to G'(GG')^+ Gy, and x'y (zero without x)."""
        coarse_space, layout = self.coarse_space, self.coarse_space.constraints.layout
        chosen, weak = self.held.part(part), self.gram.motions.shape[1]
        # all holders of a component have the same of x, so each may multiply its part of y
        numbers = np.append(self.gram.rows.T @ chosen, [] if x is None else x @ part)
        own, sums = self.gram.factor.solve_sum(
            coarse_space.restrict_own(chosen), coarse_space.restrict_others(chosen), numbers
        )
        if resisted and self.free.shape[1]:
            free = coarse_space.own_part(self.free)
            own = own - free @ layout.space.sum_over_ranks(free.T @ own)
        motion = coarse_space.prolong_own(own) + layout.owned_part(self.gram.rows @ sums[:weak])
        return motion, float(sums[weak:].sum())

    def _sum(self, part: Vector) -> Vector:
        return self.coarse_space.constraints.layout.sum(part)


def _without_soft_springs(coarse_space: CoarseSpace, face: Face) -> tuple[Face, Mask | None]:
    """Return a face without its soft springs, and their rows (m,). Collective.

    It is the face itself, on all ranks, where it has none, or where they alone resist a motion.
    """
    soft = face.soft
    if soft is None or not any_rank(coarse_space.comm, soft):
        return face, None
    held = replace(face, rows=face.rows & ~soft)
    resistances = (coarse_space.resistance(f) for f in (held, face))
    less, all_of_it = (resistance.free.shape[1] for resistance in resistances)
    return (face, None) if less > all_of_it else (held, soft)


def _orthonormal_motions(coarse_space: CoarseSpace, z: sp.csr_matrix) -> tuple[sp.csr_matrix, int]:
    """Return an orthonormal basis (coarse, k) of motions z, and how many of one body come first."""
    if not z.shape[1]:
        return sp.csr_matrix((coarse_space.size, 0)), 0
    motions = coarse_space.coarse_motions(z)
    alone = of_one_body(z.tocsc(), coarse_space.bodies.modes)
    return orthonormal_columns(motions[:, alone], motions[:, ~alone]), np.count_nonzero(alone)
