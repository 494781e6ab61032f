"""The position of loose bodies in which the signs of gaps are tested.

The multipliers on a face determine the displacements up to the rigid motions that its rows leave
free. Rows off the face are moved by these motions: what is penetrated in one position of a loose
body is open in another one. Their gaps are tested in the position with the smallest sum of squares
of penetrations. If that sum is zero no row of these bodies has a wrong sign. If it is not, the
body is squeezed by others, and penetrations are forces in balance on the free motions, since the
sum's gradient with respect to them vanishes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.tolerances import MANY, ZERO, rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import bounded_springs
from fenics_tfeti.typing import Numbers, Vector

# rows of a product that are formed at once
_AT_ONCE = 10_000


@dataclass(frozen=True)
class LooseBodies:
    """Motions that a face leaves free, and the contact rows that they move."""

    coarse_space: CoarseSpace  # G
    face: Face
    motions: sp.csr_matrix  # (modes * bodies, k): basis of the free motions, see `BodyMotions`
    rows: Numbers  # (r,): contact rows that this rank owns and that the motions move
    # (r, modes * bodies): closing of the rows by each motion of a body that moves
    closing: sp.csr_matrix

    @staticmethod
    def of(coarse_space: CoarseSpace, face: Face, motions: sp.csr_matrix) -> LooseBodies | None:
        """Return those of a face with its free motions (modes * bodies, k); None without any."""
        if not motions.shape[1]:
            return None
        constraints = coarse_space.constraints
        owned = constraints.owned_contact_rows
        off = owned[~face.rows[owned]]
        rows_moved = coarse_space.bodies.moved[off] @ _moving(motions)
        # rows of unit length that a motion of size 1 does not move have traces of it
        moved = _largest_of_rows(rows_moved, motions) > rounding(1.0, MANY)
        closing = sp.diags(constraints.lengths_of_rows()[off[moved]]) @ rows_moved[moved]
        return LooseBodies(coarse_space, face, motions, off[moved], closing.tocsr())

    def motion(self, gap: Vector) -> Vector:
        """Return the free motion with the least penetration of gaps (m,). Collective."""
        return least_penetration(self.coarse_space, self.closing, gap[self.rows], self.motions)

    def at_least_penetration(self, gradient: Vector) -> Vector:
        """Return the gradient after the free motion with the least penetration. Collective.

        The gradient (m,) has on contact rows off the face their gaps, after any free motion.
        """
        coarse_space, z = self.coarse_space, self.motion(gradient)
        if not z.any():
            return gradient
        # bitwise the same on all holders of a row
        layout = coarse_space.constraints.layout
        moved = layout.sum(layout.owned_part(coarse_space.moved_rows(self.motions @ z)))
        moved -= self.face.part(moved)
        moved[coarse_space.constraints.equality] = 0.0
        moved_gradient: Vector = gradient - moved
        # bodies that find their position touch others without pressing on them
        moved_gradient[np.abs(moved_gradient) <= self._rounding(np.abs(moved))] = 0.0
        return moved_gradient

    def _rounding(self, size: Vector) -> Vector:
        """Return the penetration that rounding leaves in rows that moved so far. Collective."""
        largest = largest_of_ranks(self.coarse_space.comm, size)
        return np.maximum(ZERO * size, rounding(largest))


def least_penetration(
    coarse_space: CoarseSpace, S: sp.csr_matrix, gap: Vector, basis: sp.csr_matrix | None = None
) -> Vector:
    """Return the motion with the least penetration of all ranks' rows. Collective.

    Rows (r, n) of S are closed by the motions (n, k) of a basis, see `bounded_springs`.
    """
    return bounded_springs(
        S,
        gap,
        basis=basis,
        sum_vectors=coarse_space.constraints.layout.space.sum_over_ranks,
        sum_matrices=partial(sum_sparse, coarse_space.comm),
    )


def _moving(motions: sp.csr_matrix) -> sp.csr_matrix:
    """Return the diagonal matrix that is 1 at motions of bodies that take part in some motion."""
    return sp.diags((np.diff(motions.indptr) > 0).astype(float), format="csr")


def _largest_of_rows(A: sp.csr_matrix, B: sp.csr_matrix) -> Vector:
    """Return the largest entry of each row of |AB|; the product may be full."""
    starts = range(0, A.shape[0], _AT_ONCE)
    parts = [abs(A[k : k + _AT_ONCE] @ B).max(axis=1).toarray().ravel() for k in starts]
    return np.concatenate([np.zeros(0), *parts])
