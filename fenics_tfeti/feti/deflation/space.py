"""Deflation: F and d without directions in which F is large or negative.

Materials that jump make F large in some directions, and indefinite tangents make it negative.

With the columns C of large eigenvectors of the subdomains' dual operators (`local_spectra`), zero
on the contact rows, and the projector P_E of the equality rows, U = P_E C has G U = o and U_I = o:
lambda + U alpha satisfies the constraints of (11.36) if and only if lambda does. Minimising over
alpha leaves the same problem for lambda with the Schur complement

    F_c = F - FU (U'FU)^{-1} U'F,    d_c = d - FU (U'FU)^{-1} U'd

in place of F and d, and lambda + U (U'FU)^{-1} U'(d - F lambda) is the solution of (11.36).

With indefinite tangents K_i, alpha is a stationary point instead of the minimum. If the tangent of
the glued bodies is positive, PFP has as many negative eigenvalues as all K_i together. If U'FU has
all of them, F_c is positive semidefinite on the rest (Haynsworth).

U = C - G_E'X - WV is kept by its factors: each column of C and of G_E' belongs to one subdomain,
X = (G_E G_E')^+ G C has few rows, and W are the few motions that the equality rows resist weakly.
So B_s'U of a subdomain needs columns of C and G_E' of its neighbours only. With an orthonormal
basis Z_s of what these do to the subdomain, B_s'U = Z_s T_s: there are as few responses K_s^+ Z_s
as columns. Those of the columns themselves would cancel each other where stiff subdomains move
together, which takes large coefficients X.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import warn_user
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.costs import COLUMNS
from fenics_tfeti.feti.deflation.local_spectra import LocalVectors
from fenics_tfeti.feti.local.congruence import dense_if_small, of_subdomains
from fenics_tfeti.feti.tolerances import PARALLEL, WEAK
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Numbers, Operator, Vector

DeflationKind = Literal["auto", "on", "off"]

# vectors of all ranks: U'FU is a dense matrix on each of them, here of 72 MB
_MOST = 3000
# passes of the equilibration of U'FU: each takes the square root of what is left
_PASSES = 10


@dataclass(frozen=True)
class Response:
    """K_s^+ B_s'U = K_s^+ Z T of one subdomain."""

    displacements: Vector  # (r, b): (K_s^+ Z)' on the packed interface unknowns
    coefficients: Vector  # (r, k): T


@dataclass(frozen=True)
class Deflation:
    """The Schur complement of F with respect to the multipliers U alpha."""

    coarse_space: CoarseSpace
    vectors: LocalVectors  # columns of C of this rank's subdomains
    own: sp.csr_matrix  # (m, k): the same, placed among the columns of all ranks
    X: Vector  # (h, k): rows of the own coarse unknowns, then those of `CoarseLayout.others`
    W: Vector  # (m, w): weakly resisted motions on the equality rows
    V: Vector  # (w, k): their coefficients
    pieces: sp.csr_matrix  # (j, b): [C, G_E', W]'B on the packed interface unknowns
    responses: list[Response]  # in the order of the packed interface unknowns
    basis: Vector  # (k, r): combinations of columns of U that diagonalise U'FU
    energies: Vector  # (r,): its diagonal
    solves: int  # with K_s^+ on this rank, of the set-up

    @staticmethod
    def build(
        coarse_space: CoarseSpace,
        on_interface: Sequence[Operator],
        vectors: LocalVectors,
    ) -> Deflation | None:
        """Make U, K^+B'U and the inverse of U'FU; None if P_E leaves no vector. Collective.

        The operators apply K_i^+ between the interface unknowns of each class, (k, b) -> (k, b);
        the vectors are the columns of C of this rank's subdomains.
        """
        constraints = coarse_space.constraints
        first, total = first_of_rank(constraints.layout.comm, vectors.excess.size)
        if not total:
            return None
        own = _columns(constraints, vectors, first, total)
        everyone = constraints.layout.sum_sparse(own)
        projector = Projector.build(coarse_space, Face.supports(constraints))
        G = coarse_space.motions_of_rows(constraints.equality)
        X, W, V, squares = _coefficients(projector, G, everyone)
        parts = sp.hstack([everyone, G, sp.csr_matrix(W)])
        forces = (coarse_space.interface.transposed @ parts.tocsr()).tocsr()
        combination = np.vstack([np.identity(total), -X, -V])
        responses, gram = _responses(coarse_space, on_interface, forces, combination)
        basis, energies = _diagonalised(constraints, gram, squares > WEAK**2)
        if not energies.size:
            return None
        solves = sum(len(response.displacements) for response in responses)
        return Deflation(
            coarse_space,
            vectors,
            own,
            X,
            W,
            V,
            forces.T.tocsr(),
            responses,
            basis,
            energies,
            solves,
        )

    @property
    def size(self) -> int:
        """Number of vectors of all ranks that do not depend on others."""
        return int(self.energies.size)

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues of U'FU."""
        return int(np.count_nonzero(self.energies < 0.0))

    @property
    def bytes(self) -> int:
        """Memory of this rank."""
        arrays = [self.X, self.W, self.V, self.basis]
        arrays += [x for A in (self.own, self.pieces) for x in (A.data, A.indices)]
        arrays += self.vectors.values
        arrays += [array for response in self.responses for array in vars(response).values()]
        return sum(int(array.nbytes) for array in arrays)

    def part(self, operator: Operator, x: Vector) -> Vector:
        """Return this rank's part of F_c x, x the same on all holders; two reductions.

        The operator is this rank's K^+ on packed forces of the interface.
        """
        interface = self.coarse_space.interface
        displacements = operator(interface.transposed @ x)
        # the second time for what rounding leaves, which a large F multiplies: in a direction
        # without curvature the residual has to be zero, or conjugate gradients diverge
        for _ in range(2):
            work = self._combined(self._pieces_products @ displacements)
            displacements = displacements - self._response(self._solve(work))
        return interface.matrix @ displacements

    def reduced(self, y: Vector) -> Vector:
        """Return y - FU (U'FU)^{-1} U'y: d_c of d. Collective."""
        interface, layout = self.coarse_space.interface, self.coarse_space.constraints.layout
        for _ in range(2):
            part = interface.matrix @ self._response(self._solve(self._restricted(y)))
            y = y - layout.sum(part)
        return y

    def completed(self, multipliers: Vector, rest: Vector, at: Vector) -> Vector:
        """Return lambda + U (U'FU)^{-1} U'(d - F lambda), stationary over lambda + U alpha.

        All arguments are (m,); rest is d - F times the other multipliers `at`.
        """
        forces = self.coarse_space.interface.transposed @ (at - multipliers)
        alpha = self._solve(self._restricted(rest)) + self._coefficients_of(forces)
        return multipliers + self.prolonged(alpha)

    def prolonged(self, alpha: Vector) -> Vector:
        """Return U alpha; one exchange."""
        coarse_space, constraints = self.coarse_space, self.coarse_space.constraints
        own = self.X[: int(coarse_space.ends[-1])] @ alpha
        part = self.own @ alpha - coarse_space.prolong_own(own)
        whole = constraints.layout.sum(part) - self.W @ (self.V @ alpha)
        return np.where(constraints.equality, whole, 0.0)

    def _restricted(self, y: Vector) -> Vector:
        """Return U'y for y that all holders have whole; one reduction."""
        coarse_space, constraints = self.coarse_space, self.coarse_space.constraints
        y = np.where(constraints.equality, y, 0.0)
        owned = constraints.layout.owned
        own = self.X[: int(coarse_space.ends[-1])]
        part = self._own_transposed @ y - own.T @ coarse_space.restrict_own(y)
        part -= self.V.T @ (self.W[:owned].T @ y[:owned])
        return constraints.layout.space.sum_over_ranks(part)

    @cached_property
    def _pieces_products(self) -> sp.csr_matrix | Vector:
        return dense_if_small(self.pieces)

    @cached_property
    def _own_transposed(self) -> sp.csc_matrix:
        return self.own.T

    def _coefficients_of(self, forces: Vector) -> Vector:
        """Return (U'FU)^{-1} U'F x for packed forces B'x; one reduction."""
        part, end = np.zeros(self.X.shape[1]), 0
        for response in self.responses:
            begin, end = end, end + response.displacements.shape[1]
            part += response.coefficients.T @ (response.displacements @ forces[begin:end])
        return self._solve(self._sum(part))

    def _combined(self, products: Vector) -> Vector:
        """Return U'y, given the ranks' parts of [C, G_E', W]'y; one reduction."""
        k, h = self.X.shape[1], len(self.X)
        part = products[:k] - self.X.T @ products[k : k + h] - self.V.T @ products[k + h :]
        return self._sum(part)

    def _sum(self, part: Vector) -> Vector:
        return self.coarse_space.constraints.layout.space.sum_over_ranks(part)

    def _response(self, alpha: Vector) -> Vector:
        """Return K^+B'U alpha on this rank's packed interface unknowns."""
        parts = [(r.coefficients @ alpha) @ r.displacements for r in self.responses]
        return np.concatenate([np.zeros(0), *parts])

    def _solve(self, right: Vector) -> Vector:
        """Return (U'FU)^+ applied to a vector."""
        return self.basis @ ((self.basis.T @ right) / self.energies)


def at_most(comm: MPI.Intracomm, vectors: LocalVectors, most: int = _MOST) -> LocalVectors:
    """Return the vectors with the largest values, as many as a dense matrix is good for.

    Warns on all ranks if some are left out. Collective.
    """
    excess = np.sort(concatenate_ranks(comm, vectors.excess))[::-1]
    if excess.size <= most:
        return vectors
    warn_user(
        f"deflation: {excess.size} directions in which the dual operator is large, more than the "
        f"{most} that a dense matrix is made for; the others may cost many iterations. Larger "
        "subdomains (option 'subdomain_size') cut fewer stiff parts of the material",
    )
    return vectors.chosen((vectors.excess > excess[most]) | np.isinf(vectors.excess))


def same_equality_rows(one: Constraints, other: Constraints) -> bool:
    """Tell, with one answer on all ranks, whether both have the same equality rows. Collective."""
    numbers, matrices = list[Numbers](), list[sp.csr_matrix]()
    for constraints in (one, other):
        rows = np.flatnonzero(constraints.equality)
        rows = rows[np.argsort(constraints.layout.numbers[rows])]
        numbers.append(constraints.layout.numbers[rows])
        matrices.append(constraints.matrix[rows])
    same = (
        matrices[0].shape == matrices[1].shape
        and np.array_equal(numbers[0], numbers[1])
        and (matrices[0] != matrices[1]).nnz == 0
    )
    return bool(one.layout.comm.allreduce(same, MPI.LAND))


def _columns(
    constraints: Constraints, vectors: LocalVectors, first: int, total: int
) -> sp.csr_matrix:
    """Return vectors as columns in their places among those of all ranks."""
    sizes = [rows.size for rows in vectors.rows]
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *vectors.rows])
    values = np.concatenate([np.zeros(0), *vectors.values])
    places = np.repeat(first + np.arange(len(sizes)), sizes)
    shape = constraints.size, total
    return sp.csr_matrix((values, (constraints.layout.local(rows), places)), shape=shape)


def _coefficients(
    projector: Projector, G: sp.csr_matrix, C: sp.csr_matrix
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return X, W and V of P_E C = C - G_E'X - WV, and the squares of the lengths of its columns.

    G are the motions of the equality rows; the columns of C are those of all ranks, of length 1.
    Collective.
    """
    coarse_space, layout = projector.coarse_space, projector.coarse_space.layout
    restriction = G[:, : int(coarse_space.ends[-1])].T
    places = np.concatenate([np.arange(layout.size)[layout.own], layout.others])
    gram = projector.gram
    W = np.where(projector.face.rows[:, None], gram.rows, 0.0)
    X, V = np.zeros((places.size, C.shape[1])), np.zeros((W.shape[1], C.shape[1]))
    squares, owned = np.zeros(C.shape[1]), coarse_space.constraints.layout.owned
    for first in range(0, C.shape[1], COLUMNS):
        some = slice(first, first + COLUMNS)
        U = C[:, some].toarray()
        for _ in range(projector.passes):
            coarse = projector.without_free_motions(layout.gather(restriction @ U))
            x, v = gram.factor.solve(coarse)[places], gram.motions.T @ coarse
            U -= G @ x + W @ v
            X[:, some] += x
            V[:, some] += v
        squares[some] = np.sum(U[:owned] ** 2, axis=0)
    return X, W, V, coarse_space.constraints.layout.space.sum_over_ranks(squares)


def _responses(
    coarse_space: CoarseSpace,
    on_interface: Sequence[Operator],
    forces: sp.csr_matrix,
    combination: Vector,
) -> tuple[list[Response], Vector]:
    """Return the response of each subdomain to the columns of U, and this rank's part of U'FU."""
    total, responses = combination.shape[1], list[Response]()
    gram = np.zeros((total, total))
    interface = coarse_space.interface
    operators = of_subdomains(interface.classes, on_interface)
    for operator, begin, end in zip(
        operators, interface.ends[:-1], interface.ends[1:], strict=True
    ):
        columns, parts = _filled_columns(forces, int(begin), int(end))
        T = combination[columns]
        if columns.size > total:
            # those of U itself are fewer
            parts, T = T.T @ parts, np.identity(total)
        Z, R = np.linalg.qr(parts.T)
        displacements, T = operator(Z.T), R @ T
        gram += T.T @ ((displacements @ Z) @ T)
        responses.append(Response(displacements, T))
    return responses, gram


def _filled_columns(matrix: sp.csr_matrix, begin: int, end: int) -> tuple[Numbers, Vector]:
    """Return the columns that have entries in some rows, and these rows, dense and transposed."""
    indptr = matrix.indptr[begin : end + 1]
    indices, values = (x[indptr[0] : indptr[-1]] for x in (matrix.indices, matrix.data))
    filled = np.zeros(matrix.shape[1], dtype=bool)
    filled[indices] = True
    columns = np.flatnonzero(filled)
    place = np.empty(filled.size, dtype=np.int64)
    place[columns] = np.arange(columns.size)
    dense = np.zeros((columns.size, end - begin))
    dense[place[indices], np.repeat(np.arange(end - begin), np.diff(indptr))] = values
    return columns, dense


def _diagonalised(
    constraints: Constraints, gram: Vector, nonzero: NDArray[np.bool_]
) -> tuple[Vector, Vector]:
    """Return combinations (k, r) of columns of U that diagonalise U'FU, and the diagonal (r,).

    Two subdomains may have the same vector for the jump between them, and vectors in the range of
    G_E' leave nothing: eigenvalues that are zero are left out. Every rank gets the same.
    """
    comm = constraints.layout.comm
    whole = constraints.layout.space.sum_over_ranks(gram)
    comm.Bcast(whole)
    comm.Bcast(nonzero)
    kept = np.flatnonzero(nonzero)
    whole = 0.5 * (whole + whole.T)[np.ix_(kept, kept)]
    lengths = _equilibration(whole)
    energies, vectors = np.linalg.eigh(whole / np.outer(lengths, lengths))
    large = np.abs(energies) > PARALLEL * np.abs(energies).max(initial=0.0)
    basis = np.zeros((gram.shape[0], np.count_nonzero(large)))
    basis[kept] = vectors[:, large] / lengths[:, None]
    return basis, energies[large]


def _equilibration(matrix: Vector) -> Vector:
    """Return lengths s with 1 as the largest entry of each row of M_ij / (s_i s_j).

    Those of a positive definite matrix are the square roots of its diagonal.
    """
    size = np.abs(matrix)
    lengths = np.ones(len(matrix))
    for _ in range(_PASSES):
        largest = (size / lengths[:, None] / lengths).max(axis=1, initial=0.0)
        lengths *= np.sqrt(np.where(largest > 0.0, largest, 1.0))
    return lengths
