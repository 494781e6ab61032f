"""The position of loose bodies in which gaps are judged.

The multipliers on a face determine the displacements up to the rigid motions that its rows leave
free. Rows off the face are moved by these motions: what is penetrated in one position of a loose
body is open in another one. Their gaps are judged in the position with the smallest sum of squares
of penetrations. If that sum is zero no row of these bodies has a wrong sign. If it is not, the
body is squeezed by others, and penetrations are forces in balance on the free motions, since the
sum's gradient with respect to them vanishes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.qp import least_penetration

__all__ = ["LooseBodies"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# closing of a row, relative to its length, by a unit motion that does not move it
_TRACE = 1e-13
# penetration that rounding leaves, relative to what the motion changes in the row
_CLOSED = 1e-9


@dataclass(frozen=True)
class LooseBodies:
    """Motions that a face leaves free, and the contact rows that they move.

    Attributes
    ----------
    projector : Projector
        That of the face.
    rows : (r,) integer array
        Contact rows off the face that this rank owns and that the motions move.
    closing : (r, k) scipy.sparse.csr_matrix
        By how much each motion closes them.
    """

    projector: Projector
    rows: Numbers
    closing: sp.csr_matrix

    @staticmethod
    def of(projector: Projector) -> LooseBodies | None:
        """Return those of a face; None if it leaves no motion free."""
        if not projector.free.shape[1]:
            return None
        coarse_space, constraints = projector.coarse_space, projector.coarse_space.constraints
        owned = constraints.inequality[: constraints.owned_inequalities]
        off = np.flatnonzero(~projector.rows[owned])
        closing = (coarse_space.contact[:, off].T @ projector.free).tocsr()
        largest = abs(closing).max(axis=1).toarray().ravel()
        moved = largest > _TRACE * constraints.row_lengths[owned[off]]
        return LooseBodies(projector, owned[off[moved]], closing[np.flatnonzero(moved)])

    def settled(self, gradient: Vector) -> Vector:
        """Return the gradient after the motion with the least penetration. Collective.

        Parameters
        ----------
        gradient : (m,) array
            On contact rows off the face their gaps, after any free motion.
        """
        coarse_space = self.projector.coarse_space
        space, comm = coarse_space.constraints.layout.space, coarse_space.comm
        z = least_penetration(
            self.closing,
            gradient[self.rows],
            space.sum_over_ranks,
            lambda part: sum_sparse(comm, part),
        )
        if not z.any():
            return gradient
        moved = coarse_space.prolong(self.projector.free @ z)
        moved -= self.projector.on_rows(moved)
        moved[coarse_space.constraints.equality] = 0.0
        settled: Vector = gradient - moved
        # bodies that find their position touch others without pressing on them
        rounding = np.abs(settled) <= _CLOSED * np.abs(moved)
        settled[rounding] = 0.0
        return settled
