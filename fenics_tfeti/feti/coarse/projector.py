"""The projectors P and Q to the natural coarse space and its complement (sec. 11.8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from fenics_tfeti.feti.coarse.factor import (
    CoarseFactor,
)
from fenics_tfeti.feti.coarse.space import CoarseSpace

__all__ = ["Projector"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Projector:
    """Q and P for the equality rows and some contact rows (all of them, none, the active ones).

    Attributes
    ----------
    space : CoarseSpace
        G.
    columns : (m,) bool array
        The columns of G used.
    free : (coarse, k) array
        Orthonormal basis of the kernel of the coarse matrix.
    factor : CoarseFactor or None
        That of the coarse matrix; None where no subdomain can move.
    """

    space: CoarseSpace
    columns: Mask
    free: Vector
    factor: CoarseFactor | None

    @staticmethod
    def build(space: CoarseSpace, active: Mask | None = None) -> Projector:
        """Factor the coarse matrix GG' of the equality rows and the chosen contact rows.

        Parameters
        ----------
        space : CoarseSpace
            G.
        active : (i,) bool array, optional
            The contact rows; all by default.
        """
        constraints = space.constraints
        chosen = np.ones(constraints.inequality.size, dtype=bool) if active is None else active
        columns = constraints.equality
        columns[constraints.inequality] = chosen
        free = space.unresisted(chosen)
        contact = space.contact[:, np.flatnonzero(chosen)]
        layout = space.layout
        rows = space.equality + layout.rows((contact[layout.mine] @ contact.T).tocsr())
        if free.shape[1]:
            # no row at all leaves a zero matrix
            stiffness = layout.largest_diagonal(rows) or 1.0
            rows = layout.add_to_diagonal(rows, _pins(free), stiffness)
        return Projector(space, columns, free, layout.factor(rows) if layout.size else None)

    def coefficients(self, x: Vector) -> Vector:
        """Return (GG')^+ G x for all subdomains, G with the chosen columns."""
        return self.solve(self.space.restrict(np.where(self.columns, x, 0.0)))

    def solve(self, coarse: Vector) -> Vector:
        """Return (GG')^+ applied to a coarse vector in the range of G."""
        return coarse if self.factor is None else self.factor.solve(coarse)

    def expand(self, coarse: Vector) -> Vector:
        """Return G' applied to a coarse vector of all subdomains, in the chosen columns."""
        return np.where(self.columns, self.space.prolong(coarse), 0.0)

    def coarse(self, x: Vector) -> Vector:
        """Return Qx = G'(GG')^{-1}Gx."""
        return self.expand(self.coefficients(x))

    def complement(self, x: Vector) -> Vector:
        """Return Px = x - Qx."""
        return x - self.coarse(x)

    def complement_of_sum(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return Py in the chosen columns and x'y, y the sum of the ranks' parts; one exchange."""
        motion, xy = self._own_motion(part, x)
        return self._sum(self.keep(part - motion)), xy

    def part_of_complement(self, part: Vector) -> Vector:
        """Return this rank's part of Py in the chosen columns, y the sum of the ranks' parts."""
        return self.keep(part - self._own_motion(part)[0])

    def coarse_by_parts(self, x: Vector) -> tuple[Vector, Vector]:
        """Return this rank's part of Qx, and Qx itself without an exchange of multipliers.

        The latter is not bitwise the same on all ranks that hold a component: good for products
        that are summed, not for what is compared with bounds.
        """
        if self.factor is None:
            return np.zeros_like(x), np.zeros_like(x)
        own, theirs = self.factor.solve_own(self.space.restrict_own(self.keep(x)))
        part = self.keep(self.space.prolong_own(own))
        return part, part + self.keep(self.space.theirs.T @ theirs)

    def relax(self, part: Vector, x: Vector) -> tuple[Vector, float]:
        """Return y - G'a, y the sum of the ranks' parts, with the motions a = (GG')^+ Gy; and x'y.

        That is Py in the chosen columns; in the others it says what the motions do there. Of the
        motions that the chosen columns leave free, a has none. One neighbour exchange; x'y is
        summed along with Gy.

        Parameters
        ----------
        part : (m,) array
            This rank's part of y.
        x : (m,) array
            A vector whose inner product with y is wanted.
        """
        motion, xy = self._own_motion(part, x, resisted=True)
        return self._sum(part - motion), xy

    def keep(self, x: Vector) -> Vector:
        """Return x with zeros outside the chosen columns."""
        return np.where(self.columns, x, 0.0)

    def resisted(self, coarse: Vector) -> Vector:
        """Return a coarse vector of all subdomains without its part in the free motions."""
        part: Vector = coarse - self.free @ (self.free.T @ coarse)
        return part

    def _own_motion(
        self, part: Vector, x: Vector | None = None, resisted: bool = False
    ) -> tuple[Vector, float]:
        """Return what this rank's subdomains add to G'(GG')^+ Gy, and x'y (zero without x)."""
        sum_over_ranks = self.space.constraints.multipliers.space.sum_over_ranks
        # all holders of a component have the same of x, so each may multiply its part of y
        numbers = np.zeros(0) if x is None else np.array([x @ part])
        if self.factor is None:
            return np.zeros_like(part), float(sum_over_ranks(numbers).sum())
        chosen = self.keep(part)
        own, numbers = self.factor.solve_sum(
            self.space.restrict_own(chosen), self.space.theirs @ chosen, numbers
        )
        if resisted and self.free.shape[1]:
            free = self.space.own_part(self.free)
            own = own - free @ sum_over_ranks(free.T @ own)
        return self.space.prolong_own(own), float(numbers.sum())

    def _sum(self, part: Vector) -> Vector:
        return self.space.constraints.multipliers.sum(part)


def _pins(free: Vector) -> Numbers:
    """Return one coarse unknown for each free motion, to pin by a number on the diagonal.

    The coarse matrix is definite then, and for right-hand sides without a part in `free` the
    pinned unknowns are zero: its inverse is a generalized inverse of the coarse matrix.
    """
    pivots: Numbers = qr(free.T, mode="economic", pivoting=True)[2][: free.shape[1]]
    return pivots.astype(np.int64)
