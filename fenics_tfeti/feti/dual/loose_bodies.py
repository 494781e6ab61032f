"""The position of loose bodies in which gaps are judged.

The multipliers on a face determine the displacements up to the rigid motions that its rows leave
free. Rows off the face are moved by these motions: what is penetrated in one position of a loose
body is open in another one. Their gaps are judged in the position with the smallest sum of squares
of penetrations. If that sum is zero no row of these bodies has a wrong sign. If it is not, the
body is squeezed by others, and penetrations are forces in balance on the free motions, since the
sum's gradient with respect to them vanishes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.dual.problem import DualProblem
from fenics_tfeti.qp import least_penetration

__all__ = ["LooseBodies", "rigid_start"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# stiffness of a row of B in units of that of its nodes (the diagonal of K): what the neighbours on
# a surface give way
_OF_SURFACE = 0.3
# closing of a row, relative to its length, by a unit motion that does not move it
_TRACE = 1e-13
# penetration that rounding leaves, relative to what the motion changes in the row
_CLOSED = 1e-9


@dataclass(frozen=True)
class LooseBodies:
    """Motions that rows leave free, and the contact rows that they move.

    Attributes
    ----------
    coarse_space : CoarseSpace
        G.
    motions : (coarse, k) scipy.sparse.csr_matrix
        Basis of the free motions.
    rows : (r,) integer array
        Contact rows that this rank owns and that the motions move.
    closing : (r, k) scipy.sparse.csr_matrix
        By how much each motion closes them.
    held : callable
        y -> its part on the rows that leave the motions free.
    """

    coarse_space: CoarseSpace
    motions: sp.csr_matrix
    rows: Numbers
    closing: sp.csr_matrix
    held: Callable[[Vector], Vector]

    @staticmethod
    def on_face(projector: Projector) -> LooseBodies | None:
        """Return those of a face; None if it leaves no motion free."""
        return LooseBodies._of(
            projector.coarse_space, projector.free, projector.rows, projector.on_rows
        )

    @staticmethod
    def without(coarse_space: CoarseSpace, rows: Mask) -> LooseBodies | None:
        """Return those that some rows leave loose; None if they leave no motion free. Collective.

        Parameters
        ----------
        coarse_space : CoarseSpace
            G.
        rows : (m,) bool array
            The rows.
        """
        free = coarse_space.coarse_motions(coarse_space.weakly_resisted(rows)[0])
        return LooseBodies._of(coarse_space, free, rows, lambda y: np.where(rows, y, 0.0))

    @staticmethod
    def _of(
        coarse_space: CoarseSpace,
        motions: sp.csr_matrix,
        rows: Mask,
        held: Callable[[Vector], Vector],
    ) -> LooseBodies | None:
        if not motions.shape[1]:
            return None
        constraints = coarse_space.constraints
        owned = constraints.inequality[: constraints.owned_inequalities]
        off = np.flatnonzero(~rows[owned])
        closing = (coarse_space.contact[:, off].T @ motions).tocsr()
        largest = abs(closing).max(axis=1).toarray().ravel()
        moved = np.flatnonzero(largest > _TRACE * constraints.row_lengths[owned[off]])
        return LooseBodies(coarse_space, motions, owned[off[moved]], closing[moved], held)

    def settled(self, gradient: Vector) -> Vector:
        """Return the gradient after the motion with the least penetration. Collective.

        Parameters
        ----------
        gradient : (m,) array
            On contact rows off the face their gaps, after any free motion.
        """
        z = self._motion(gradient)
        if not z.any():
            return gradient
        moved = self.coarse_space.prolong(self.motions @ z)
        moved -= self.held(moved)
        moved[self.coarse_space.constraints.equality] = 0.0
        settled: Vector = gradient - moved
        # bodies that find their position touch others without pressing on them
        settled[np.abs(settled) <= self._rounding(np.abs(moved))] = 0.0
        return settled

    def pressing(self, gap: Vector, load: Vector) -> Vector:
        """Return the forces on the rows if bodies were rigid and the rows springs of stiffness 1.

        Parameters
        ----------
        gap : (m,) array
            Gaps of the contact rows.
        load : (coarse,) array
            Load of the bodies, which the rows can balance.

        Returns
        -------
        (m,) array
            Zero but for contact rows that press. Collective.
        """
        z = self._motion(gap, self.motions.T @ load)
        moved = self.coarse_space.prolong(self.motions @ z)
        rows, forces = self.coarse_space.constraints.inequality, np.zeros_like(gap)
        depth = (moved - gap)[rows]
        touching = self._rounding(np.abs(moved[rows]))
        forces[rows] = np.where(depth > touching, depth, 0.0)
        return forces - self.held(forces)

    def _rounding(self, size: Vector) -> Vector:
        """Return the penetration that rounding leaves in rows that moved so far. Collective."""
        largest = float(self.coarse_space.comm.allreduce(size.max(initial=0.0), MPI.MAX))
        return np.maximum(_CLOSED * size, np.finfo(float).eps * largest)

    def _motion(self, gap: Vector, load: Vector | None = None) -> Vector:
        coarse_space = self.coarse_space
        space, comm = coarse_space.constraints.layout.space, coarse_space.comm
        return least_penetration(
            self.closing,
            gap[self.rows],
            space.sum_over_ranks,
            lambda part: sum_sparse(comm, part),
            load,
        )


def rigid_start(problem: DualProblem) -> Vector | None:
    """Return the contact forces between rigid bodies with elastic surfaces. Collective.

    Where contact holds bodies against the load, the elastic solution has about the same rows in
    contact: between rigid rings the load is shared by as many rollers.

    Parameters
    ----------
    problem : DualProblem
        The dual problem.

    Returns
    -------
    (m,) array or None
        Multipliers, zero but for contact rows that press; None if the equality rows balance the
        load.
    """
    none = np.zeros(problem.constraints.inequality.size, dtype=bool)
    projector = Projector.build(problem.coarse_space, none)
    loose = LooseBodies.on_face(projector)
    if loose is None:
        return None
    load = projector.unresisted(problem.e, problem.e_size)
    if not load.any():
        return None
    stiffness = _OF_SURFACE * problem.unit
    return stiffness * loose.pressing(problem.c, load / stiffness)
