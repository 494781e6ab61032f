"""The natural coarse space: G = R'B', the projectors P and Q, and what G leaves free (sec. 11.8).

G with orthonormal rows is needed only through Q = G~'(G~G~')^{-1}G~ of G~ = R'B', so the coarse
matrix G~G~' is factored and T never formed. Where some rigid motions meet no constraint at all, the
coarse matrix is singular and a generalized inverse takes its place; Q is the same for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.body_motions import BodyMotions, body_motions
from fenics_tfeti.feti.coarse.face_cache import FaceCache
from fenics_tfeti.feti.coarse.factor import (
    CoarseLayout,
    CoarseSolverKind,
    choose_coarse_solver,
)
from fenics_tfeti.feti.coarse.resistance import Resistance, weak_motions
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.interface import Interface
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.factors.cholesky import available_packages
from fenics_tfeti.feti.local.congruence import CongruenceClass, dense_if_small
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import SOFT, WEAK, ZERO
from fenics_tfeti.parallel import first_of_rank, largest_of_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class CoarseSpace:
    """G = R'B' on this rank, and the bodies' rigid motions.

    G' is kept for this rank's subdomains, and for what others' add to the components held here;
    its contact columns and GG' of the equality rows are kept for the subdomains of all ranks.
    """

    interface: Interface
    kernels: Sequence[Vector]  # R_i (n_i, k_i) in their frames; congruent subdomains share it
    ends: Numbers  # (subdomains + 1,): first own coarse unknown of each, and the end
    layout: CoarseLayout
    own: sp.csr_matrix  # (m, own): G' of this rank's subdomains
    others: sp.csr_matrix  # (h, m): rows of G of other ranks' subdomains, columns held here
    contact: sp.csr_matrix  # (coarse, i): all rows of G, inequality columns held here
    friction: sp.csr_matrix  # (coarse, m): all rows of G; zero but in tangential rows
    equality: sp.csr_matrix  # (coarse or own, coarse): GG' of the equality rows, rows kept here
    bodies: BodyMotions
    constraints: Constraints
    faces: FaceCache  # what belongs to the projectors of the last faces

    @staticmethod
    def build(
        system: TornSystem,
        constraints: Constraints,
        interface: Interface,
        kernels: Sequence[Vector],
        package: str,
        solver: CoarseSolverKind = "auto",
    ) -> CoarseSpace:
        """Form G and exchange its shared columns with the neighbours.

        The package is that for factors of coarse matrices that are whole on every rank. Collective.
        """
        ends = np.cumsum([0, *(R.shape[1] for R in kernels)])
        first, size = first_of_rank(system.comm, int(ends[-1]))
        # G' with this rank's rows of G as columns, then with those of all
        own = _trimmed((interface.matrix @ _packed_kernels(interface, kernels, ends)).tocsr())
        everyone = own
        if system.comm.size > 1:
            among_all = (own.data, own.indices + first, own.indptr), (own.shape[0], size)
            everyone = constraints.layout.sum_sparse(sp.csr_matrix(*among_all))
        glued = own[constraints.equality]
        glued_everyone = glued if everyone is own else everyone[constraints.equality]
        rows = (glued.T.tocsr() @ glued_everyone).tocsr()
        del glued, glued_everyone
        own_columns = (everyone.indices >= first) & (everyone.indices < first + ends[-1])
        others = np.unique(everyone.indices[~own_columns])
        if solver == "auto":
            solver = choose_coarse_solver(system.comm.size, size, "mumps" in available_packages())
        layout = CoarseLayout.build(
            system.comm, int(ends[-1]), others.astype(np.int64), solver, package
        )
        return CoarseSpace(
            interface,
            kernels,
            ends,
            layout,
            own,
            everyone[:, others].T.tocsr(),
            everyone[constraints.inequality].T.tocsr(),
            (_chosen_rows(constraints.friction.flat, constraints.size) @ everyone).T.tocsr(),
            layout.rows(rows),
            body_motions(system, kernels, constraints, everyone),
            constraints,
            FaceCache(system.comm),
        )

    @property
    def size(self) -> int:
        """Number of coarse unknowns of all ranks."""
        return self.layout.size

    def find_longest_row(self) -> float:
        """Return the largest length of a row of B. Collective."""
        return largest_of_ranks(self.comm, self.constraints.lengths_of_rows())

    @property
    def comm(self) -> MPI.Intracomm:
        """The ranks."""
        return self.constraints.layout.comm

    def restrict(self, x: Vector) -> Vector:
        """Return Gx for the coarse unknowns of all ranks; one gathering."""
        return self.layout.gather(self.restrict_own(x))

    def restrict_own(self, x: Vector) -> Vector:
        """Return Gx for this rank's coarse unknowns."""
        return self._own_transposed @ x

    def restrict_others(self, x: Vector) -> Vector:
        """Return Gx for the coarse unknowns of other ranks' subdomains, (h,)."""
        return self._others_products @ x

    @cached_property
    def _own_products(self) -> sp.csr_matrix | Vector:
        return dense_if_small(self.own)

    @cached_property
    def _own_transposed(self) -> sp.csc_matrix | Vector:
        # made once: on small problems it takes longer than the product
        return self._own_products.T

    @cached_property
    def _others_products(self) -> sp.csr_matrix | Vector:
        return dense_if_small(self.others)

    @cached_property
    def others_transposed(self) -> sp.csc_matrix:
        """G' of other ranks' subdomains, (m, h), on the columns held here."""
        return self.others.T

    def prolong(self, coarse: Vector) -> Vector:
        """Return G'a for a coarse vector of all ranks; one neighbour exchange."""
        return self.constraints.layout.sum(self.prolong_own(self.own_part(coarse)))

    def prolong_own(self, own: Vector) -> Vector:
        """Return what this rank's coarse unknowns add to G'a."""
        return self._own_products @ own

    def columns(self, face: Face) -> sp.csr_matrix:
        """Return the columns of G of a face, but equality rows, on all ranks' unknowns."""
        constraints, rows, combined = self.constraints, face.rows, face.combinations()
        columns = [self.contact[:, np.flatnonzero(rows[constraints.inequality])]]
        if constraints.friction.size:
            columns.append(self.friction[:, np.flatnonzero(rows & ~constraints.equality)])
        if combined is not None:
            columns.append(self.friction @ combined.T)
        return sp.hstack(columns, format="csr")

    def motions_of_rows(self, rows: Mask) -> sp.csr_matrix:
        """Return G' on some rows: the columns of this rank's coarse unknowns, then of `others`."""
        chosen = sp.diags(rows.astype(float))
        return (chosen @ sp.hstack([self.own, self.others_transposed])).tocsr()

    def coarse_load(self, forces: Vector) -> Vector:
        """Return R'f, the coarse load of forces on the torn unknowns; one gathering."""
        return self._restricted(forces, lambda part: part)

    def coarse_load_size(self, forces: Vector) -> Vector:
        """Return |R|'|f|, which the rounding of R'f is relative to; one gathering."""
        return self._restricted(forces, np.abs)

    def _restricted(self, forces: Vector, measure: Callable[[Vector], Vector]) -> Vector:
        part = np.empty(int(self.ends[-1]))
        for congruent in self.interface.classes:
            R = measure(self.kernels[congruent.first])
            for batch in congruent.batches():
                part[self._places(batch)] = measure(batch.rows(forces)) @ R
        return self.layout.gather(part)

    def rigid_motion(self, coarse: Vector) -> Vector:
        """Return R a on this rank's torn unknowns for a coarse vector of all ranks."""
        return self._moved(self.own_part(coarse), lambda part: part)

    def rigid_motion_size(self, coarse: Vector) -> Vector:
        """Return |R||a|, which the rounding of R a is relative to."""
        return self._moved(np.abs(self.own_part(coarse)), np.abs)

    def _moved(self, own: Vector, measure: Callable[[Vector], Vector]) -> Vector:
        displacement = np.empty(self.constraints.matrix.shape[1])
        for congruent in self.interface.classes:
            R = measure(self.kernels[congruent.first])
            for batch in congruent.batches():
                batch.put(displacement, own[self._places(batch)] @ R.T)
        return displacement

    def without_rigid_motion(self, x: Vector) -> Vector:
        """Return x - RR'x on this rank's torn unknowns."""
        rest = np.empty_like(x)
        for congruent in self.interface.classes:
            R = self.kernels[congruent.first]
            for batch in congruent.batches():
                rows = batch.rows(x)
                batch.put(rest, rows - (rows @ R) @ R.T)
        return rest

    def own_part(self, coarse: Vector) -> Vector:
        """Return this rank's part of a coarse vector."""
        return coarse[self.layout.own]

    def _places(self, congruent: CongruenceClass) -> Numbers:
        modes = self.kernels[congruent.first].shape[1]
        return self.ends[congruent.members][:, None] + np.arange(modes)

    def resistance(self, face: Face, below: float = WEAK) -> Resistance:
        """Return the rigid motions of bodies that a face resists by no more than a limit.

        By default these are the motions whose resistance, squared in GG', would be lost to
        rounding. Collective.
        """
        of_supports = self.resistance_of_supports()
        if not of_supports.values.size:
            # the equality rows resist more than that already
            return of_supports
        return self._resistance(face, below)

    def resistance_of_supports(self, springs: Springs | None = None) -> Resistance:
        """Return the motions of bodies that equality rows resist softly, or not at all.

        With springs, those that these do not resist either. Collective at first.
        """
        if springs is None or not self._of_supports.values.size:
            return self._of_supports
        return self._resistance(Face.supports(self.constraints, springs), SOFT)

    @cached_property
    def _of_supports(self) -> Resistance:
        return self._resistance(Face.supports(self.constraints), SOFT)

    def _resistance(self, face: Face, below: float) -> Resistance:
        owned = np.flatnonzero(face.rows[: self.constraints.layout.owned])
        moved = self.bodies.moved[owned[np.diff(self.bodies.moved.indptr)[owned] > 0]]
        combinations = face.combinations()
        if combinations is not None:
            combinations = combinations[self.constraints.owned_sites]
            moved = sp.vstack([moved, combinations @ self.bodies.moved], format="csr")
        unresisted = max(ZERO, self.bodies.rounding)
        return weak_motions(self.comm, moved, self.bodies.supports, below, unresisted)

    def coarse_motions(self, z: Any) -> Any:
        """Return the coarse vectors of motions z of bodies, sparse if these are."""
        return self.bodies.basis @ z

    def moved_rows(self, z: Vector) -> Vector:
        """Return B R T z on the rows that this rank holds, without traces of rounding.

        The motions z of bodies are (modes * bodies,) or (modes * bodies, k).
        """
        return (self.constraints.lengths_of_rows() * (self.bodies.moved @ z).T).T


def _chosen_rows(rows: Numbers, size: int) -> sp.csr_matrix:
    """Return the diagonal matrix that is 1 at some rows."""
    diagonal = np.zeros(size)
    diagonal[rows] = 1.0
    return sp.diags(diagonal, format="csr")


def _trimmed(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """Return a product in arrays of its size: SciPy's have room for entries that are zero."""
    entries = matrix.nnz
    parts = matrix.data[:entries].copy(), matrix.indices[:entries].copy(), matrix.indptr
    return sp.csr_matrix(parts, matrix.shape)


def _packed_kernels(
    interface: Interface, kernels: Sequence[Vector], ends: Numbers
) -> sp.csr_matrix:
    """Return R on the packed interface unknowns, a column for each own coarse unknown."""
    traces = [
        kernels[congruent.first][local]
        for congruent, local in zip(interface.classes, interface.unknowns, strict=True)
    ]
    sizes = [c.members.size * R.size for c, R in zip(interface.classes, traces, strict=True)]
    data, columns = np.empty(sum(sizes)), np.empty(sum(sizes), dtype=np.int32)
    counts, end = [np.zeros(1, dtype=np.int32)], 0
    for congruent, R, size in zip(interface.classes, traces, sizes, strict=True):
        start, end, k = end, end + size, congruent.members.size
        places = ends[congruent.members][:, None, None] + np.arange(R.shape[1])
        data[start:end].reshape(k, *R.shape)[:] = R
        columns[start:end].reshape(k, *R.shape)[:] = places
        counts.append(np.full(k * len(R), R.shape[1], dtype=np.int32))
    indptr = np.cumsum(np.concatenate(counts))
    return sp.csr_matrix((data, columns, indptr), shape=(interface.columns.size, int(ends[-1])))
