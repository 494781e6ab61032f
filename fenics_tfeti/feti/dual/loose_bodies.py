"""The position of loose bodies in which the signs of gaps are tested.

The multipliers on a face determine the displacements up to the rigid motions that its rows leave
free. Rows off the face are moved by these motions: what is penetrated in one position of a loose
body is open in another one. Their gaps are tested in the position with the smallest sum of squares
of penetrations. If that sum is zero no row of these bodies has a wrong sign. If it is not, the
body is squeezed by others, and penetrations are forces in balance on the free motions, since the
sum's gradient with respect to them vanishes.

Motions that the rows of the face resist weakly are known only as far as the residual of the face
allows: it is least in the sense of least squares, but divided by a small resistance it may be a
large motion. Where the penetration is larger than the residual they take part, with the squares
of the residual added to the sum, as long as the residual changes by no more than a multiple of its
norm. So a face is not left for the signs of a position that the next steps on it would correct.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.qp import projected_newton
from fenics_tfeti.typing import Mask, Numbers, Vector

# closing of a row, relative to its length, by a unit motion that does not move it
_TRACE = 1e-13
# resistance of motions whose position takes an accurate residual: distances are known to the
# residual divided by it
_WEAK = 0.1
# change of the residual by such motions, relative to the residual
_TIMES_RESIDUAL = 10.0
# rows of a product that are formed at once
_AT_ONCE = 10_000
# penetration that rounding leaves, relative to what the motion changes in the row
_CLOSED = 1e-9


@dataclass(frozen=True)
class LooseBodies:
    """Motions that rows leave free, and the contact rows that they move.

    Attributes
    ----------
    coarse_space : CoarseSpace
        G.
    motions : (modes * bodies, k) scipy.sparse.csr_matrix
        Basis of the free motions, see `BodyMotions`.
    rows : (r,) integer array
        Contact rows that this rank owns and that the motions move.
    closing : (r, modes * bodies) scipy.sparse.csr_matrix
        By how much each motion of a body that moves closes them.
    held : callable
        y -> its part on the rows that leave the motions free.
    face : Projector or None
        That of the rows, where motions that these resist weakly may take part.
    """

    coarse_space: CoarseSpace
    motions: sp.csr_matrix
    rows: Numbers
    closing: sp.csr_matrix
    held: Callable[[Vector], Vector]
    face: Projector | None = None

    @staticmethod
    def on_face(projector: Projector) -> LooseBodies | None:
        """Return those of a face; None if it leaves no motion free."""
        loose = LooseBodies._of(
            projector.coarse_space, projector.free_bodies, projector.rows, projector.on_rows
        )
        if loose is None or projector.across is not None:
            return loose
        return replace(loose, face=projector)

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
        free = coarse_space.weakly_resisted(rows)[0]
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
        off = owned[~rows[owned]]
        rows_moved = coarse_space.bodies.moved[off] @ _moving(motions)
        moved = _largest_of_rows(rows_moved, motions) > _TRACE
        closing = sp.diags(constraints.row_lengths[off[moved]]) @ rows_moved[moved]
        return LooseBodies(coarse_space, motions, off[moved], closing.tocsr(), held)

    def at_least_penetration(self, gradient: Vector) -> Vector:
        """Return the gradient after the free motion with the least penetration. Collective.

        Parameters
        ----------
        gradient : (m,) array
            On contact rows off the face their gaps, after any free motion.
        """
        return self._moved(gradient, self.motion(gradient))

    def sign_test_gradient(self, moved_gradient: Vector) -> Vector:
        """Return such a gradient after motions within the accuracy of the residual. Collective.

        It is no gradient on the face, which these motions change: what more steps on the face
        correct is decided anew after them.
        """
        if self.face is None:
            return moved_gradient
        constraints = self.coarse_space.constraints
        owned = constraints.layout.owned
        deep = np.minimum(moved_gradient[self.rows], 0.0)
        own = self.held(moved_gradient)[:owned]
        depth2, residual2 = constraints.layout.space.sum_over_ranks(
            np.array([deep @ deep, own @ own])
        )
        weak = self._weak if depth2 > residual2 else None
        if weak is None:
            return moved_gradient
        limit = _TIMES_RESIDUAL * float(np.sqrt(residual2))
        return self.at_least_penetration(weak.at_least_penetration(moved_gradient, limit))

    @cached_property
    def _weak(self) -> WeakBodies | None:
        assert self.face is not None
        return WeakBodies.of_rows(self.face.coarse_space, self.face.rows)

    def _moved(self, gradient: Vector, z: Vector) -> Vector:
        """Return the gradient after a motion."""
        if not z.any():
            return gradient
        moved = self._moved_rows(z)
        moved -= self.held(moved)
        moved[self.coarse_space.constraints.equality] = 0.0
        moved_gradient: Vector = gradient - moved
        # bodies that find their position touch others without pressing on them
        moved_gradient[np.abs(moved_gradient) <= self._rounding(np.abs(moved))] = 0.0
        return moved_gradient

    def _moved_rows(self, z: Vector) -> Vector:
        """Return what a motion does to the rows, bitwise the same on all their holders."""
        layout = self.coarse_space.constraints.layout
        return layout.sum(layout.owned_part(self.coarse_space.moved_rows(self.motions @ z)))

    def _rounding(self, size: Vector) -> Vector:
        """Return the penetration that rounding leaves in rows that moved so far. Collective."""
        largest = float(self.coarse_space.comm.allreduce(size.max(initial=0.0), MPI.MAX))
        return np.maximum(_CLOSED * size, np.finfo(float).eps * largest)

    def motion(
        self, gap: Vector, load: Vector | None = None, stiffness: sp.csr_matrix | None = None
    ) -> Vector:
        """Return the motion with the least penetration, see `projected_newton`. Collective."""
        coarse_space = self.coarse_space
        space, comm = coarse_space.constraints.layout.space, coarse_space.comm
        return projected_newton(
            self.closing,
            gap[self.rows],
            basis=self.motions,
            load=load,
            stiffness=stiffness,
            sum_vectors=space.sum_over_ranks,
            sum_matrices=lambda part: sum_sparse(comm, part),
        )


@dataclass(frozen=True)
class WeakBodies:
    """Bodies whose position the residual on a face leaves uncertain.

    Attributes
    ----------
    bodies : LooseBodies
        The motions that the face leaves free, and those that it resists weakly.
    rows : (q,) integer array
        Rows of the face that this rank owns and that bodies move.
    closing : (q, modes * bodies) scipy.sparse.csr_matrix
        By how much each motion of a body closes them.
    weak : (modes * bodies, k) scipy.sparse.csr_matrix
        The motions of `bodies`, those that the face leaves free replaced by zero.
    resistance : (k, k) scipy.sparse.csr_matrix
        C'C of what the motions close, C, on all ranks.
    """

    bodies: LooseBodies
    rows: Numbers
    closing: sp.csr_matrix
    weak: sp.csr_matrix
    resistance: sp.csr_matrix

    @staticmethod
    def of_rows(coarse_space: CoarseSpace, rows: Mask) -> WeakBodies | None:
        """Return those of some rows; None if they resist no motion weakly. Collective.

        Parameters
        ----------
        coarse_space : CoarseSpace
            G.
        rows : (m,) bool array
            The rows.
        """
        constraints, moved = coarse_space.constraints, coarse_space.bodies.moved
        free, weak = coarse_space.weakly_resisted(rows, _WEAK)
        if not weak.shape[1]:
            return None
        motions = sp.hstack([free, weak], format="csr")
        bodies = LooseBodies._of(coarse_space, motions, rows, lambda y: np.where(rows, y, 0.0))
        assert bodies is not None
        owned = np.flatnonzero(rows[: constraints.layout.owned])
        owned = owned[np.diff(moved.indptr)[owned] > 0]
        closing = (sp.diags(constraints.row_lengths[owned]) @ moved[owned]).tocsr()
        none = sp.csr_matrix(free.shape)
        weak = sp.hstack([none, weak], format="csr")
        gram = sum_sparse(coarse_space.comm, closing.T @ closing)
        return WeakBodies(bodies, owned, closing, weak, (weak.T @ gram @ weak).tocsr())

    def at_least_penetration(self, gradient: Vector, limit: float = np.inf) -> Vector:
        """Return the gradient after the motion with the least penetration and residual. Collective.

        Parameters
        ----------
        gradient : (m,) array
            Gaps, and the residual on the rows.
        limit : float
            Largest change of the residual.
        """
        space = self.bodies.coarse_space.constraints.layout.space
        load = self.weak.T @ space.sum_over_ranks(self.closing.T @ gradient[self.rows])
        z = self.bodies.motion(gradient, load, self.resistance)
        size = float(np.sqrt(z @ (self.resistance @ z)))
        return self.bodies._moved(gradient, z * (limit / size) if size > limit else z)


def _moving(motions: sp.csr_matrix) -> sp.csr_matrix:
    """Return the diagonal matrix that is 1 at motions of bodies that take part in some motion."""
    return sp.diags((np.diff(motions.indptr) > 0).astype(float), format="csr")


def _largest_of_rows(A: sp.csr_matrix, B: sp.csr_matrix) -> Vector:
    """Return the largest entry of each row of |AB|; the product may be full."""
    starts = range(0, A.shape[0], _AT_ONCE)
    parts = [abs(A[k : k + _AT_ONCE] @ B).max(axis=1).toarray().ravel() for k in starts]
    return np.concatenate([np.zeros(0), *parts])
