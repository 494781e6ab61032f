"""Motions that rows of B resist weakly or not at all, body by body as far as possible.

A motion of one body that none of its rows resists is found from the rows of this body alone. What
is left are motions of several bodies together, eigenvectors of a Gram matrix, for each connected
part of it. Many loose bodies have many free motions, each of one or a few bodies, and a basis of
them is sparse.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from fenics_tfeti.feti.coarse.column_groups import sorted_by
from fenics_tfeti.feti.tolerances import MANY, WEAK, rounding
from fenics_tfeti.parallel import concatenate_buffers
from fenics_tfeti.typing import Numbers, Vector

# each pass reduces the errors of the Gram matrix's eigenvectors by a factor of 1e-5 or less
_PASSES = 3
# share of entries from which on products of matrices are cheaper by dense algebra
_FULL = 0.1
# bodies whose numbers of rows are the same up to this are treated together
_ROWS = 8
# order up to which the eigenvalues of a Gram matrix are found by dense algebra
_LARGE = 200
# inverse iteration for larger ones: first number of vectors, steps, and shift relative to the limit
# of the eigenvalues that are looked for
_BLOCK, _ITERATIONS, _SHIFT = 8, 4, 0.01


@dataclass(frozen=True)
class Resistance:
    """The motions of bodies that a face resists by no more than a limit."""

    # (k,): (||B z||^2 + ||E z||^2)^(1/2) of each motion, at most the limit but for rounding
    values: Vector
    # (modes * bodies, k): orthonormal z; where bodies move by themselves, each is that of one body
    motions: sp.csc_matrix
    unresisted: float  # what is not more counts as none

    @cached_property
    def free(self) -> sp.csr_matrix:
        """The motions that are not resisted at all."""
        return self.motions[:, np.flatnonzero(self.values <= self.unresisted)].tocsr()

    @cached_property
    def resisted(self) -> sp.csr_matrix:
        """The others."""
        return self.motions[:, np.flatnonzero(self.values > self.unresisted)].tocsr()


def weak_motions(
    comm: MPI.Intracomm,
    rows: sp.csr_matrix,
    supports: Vector,
    below: float,
    unresisted: float,
) -> Resistance:
    """Return the motions of bodies that rows and elastic supports resist weakly or not at all.

    The rows (m, modes * bodies) are those of B of this rank, of unit length, for motions of bodies;
    ||E z|| is what elastic supports resist. Returns the motions that they resist by
    no more than `below`, those of single bodies first, and among these the translations. A motion
    of one body resisted by `unresisted` or less counts as free. Collective.
    """
    if rows.shape[1] <= _LARGE and _resist_all(comm, rows, supports, max(below, unresisted)):
        return Resistance(np.zeros(0), sp.csc_matrix((rows.shape[1], 0)), unresisted)
    E = _block_diagonal(supports)
    values, vectors = _of_single_bodies(comm, rows.tocsc(), supports)
    free = values <= unresisted
    number = free.sum(axis=1)
    # singular values descend: the last vectors of a body are the free ones
    for k in np.unique(number[number > 1]):
        vectors[number == k, :, -k:] = _translations_first(vectors[number == k, :, -k:])
    alone, others = _block_columns(vectors, free), _block_columns(vectors, ~free)
    resistance, together = _of_several_bodies(comm, rows @ others, E @ others, below)
    motions = sp.hstack([alone, others @ together], format="csc")
    return Resistance(np.concatenate([values[free], resistance]), motions, unresisted)


def _resist_all(comm: MPI.Intracomm, B: sp.csr_matrix, supports: Vector, limit: float) -> bool:
    """Tell whether the Gram matrix shows that no motion is resisted by a limit or less."""
    gram = (B.T @ B).toarray(order="C")
    comm.Allreduce(MPI.IN_PLACE, gram)
    bodies, modes, _ = supports.shape
    body, blocks = np.arange(bodies), gram.reshape(bodies, modes, bodies, modes)
    blocks[body, :, body] += np.swapaxes(supports, 1, 2) @ supports
    # a sum of absolute values is at least the largest eigenvalue
    least = limit**2 + rounding(float(np.abs(gram).sum(axis=0).max(initial=0.0)), MANY)
    gram[np.diag_indices_from(gram)] -= least
    try:
        np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        return False
    return bool(gram.size)


def _of_single_bodies(
    comm: MPI.Intracomm, rows: sp.csc_matrix, supports: Vector
) -> tuple[Vector, Vector]:
    """Return the resistance (bodies, modes) of motions of one body each, and the motions.

    Triangles of the ranks' rows are put together: nothing is squared.
    """
    bodies, modes, _ = supports.shape
    if not bodies:
        return np.zeros((0, modes)), supports
    triangles = np.zeros_like(supports)
    for of_body, blocks in _rows_of_bodies(rows, modes):
        triangles[of_body] = _triangles(blocks)
    if comm.size > 1:
        touched = np.flatnonzero(np.diff(rows.indptr[::modes]))
        of_body, gathered = _gathered(comm, touched, triangles[touched].reshape(-1, modes**2))
        triangles = np.zeros_like(supports)
        order, _, ranks = sorted_by(of_body)
        first = np.cumsum(ranks) - ranks
        # all bodies with rows on the same number of ranks at once
        for number in np.unique(ranks[ranks > 0]):
            chosen = np.flatnonzero(ranks == number)
            parts = gathered[order[first[chosen, None] + np.arange(number)]]
            triangles[chosen] = _triangles(parts.reshape(chosen.size, number * modes, modes))
    triangles = _triangles(supports, triangles)
    _, values, vectors = np.linalg.svd(triangles)
    return values, np.swapaxes(vectors, 1, 2)


def _triangles(*parts: Vector) -> Vector:
    """Return the triangular factors (k, modes, modes) of matrices (k, n, modes) put together."""
    return np.asarray(np.linalg.qr(np.concatenate(parts, axis=1), mode="r"))


def _rows_of_bodies(rows: sp.csc_matrix, modes: int) -> Iterator[tuple[Numbers, Vector]]:
    """Yield bodies and their rows (k, n, modes), for all bodies with about as many rows at once."""
    column = np.repeat(np.arange(rows.shape[1]), np.diff(rows.indptr))
    body, mode = np.divmod(column, modes)
    pairs, at = np.unique(body * rows.shape[0] + rows.indices, return_inverse=True)
    counts = np.bincount(pairs // max(rows.shape[0], 1), minlength=rows.shape[1] // modes)
    local = at.ravel() - (np.cumsum(counts) - counts)[body]
    lengths = -(-counts // _ROWS) * _ROWS
    for length in np.unique(lengths[lengths > 0]):
        chosen = np.flatnonzero(lengths == length)
        slot = np.full(counts.size, -1)
        slot[chosen] = np.arange(chosen.size)
        entry = slot[body] >= 0
        blocks = np.zeros((chosen.size, length, modes))
        blocks[slot[body[entry]], local[entry], mode[entry]] = rows.data[entry]
        yield chosen, blocks


def _translations_first(motions: Vector) -> Vector:
    """Return other bases of motions (g, modes, k) of a body: those that turn it least first."""
    translations = 2 if motions.shape[1] == 3 else 3
    turns = np.linalg.svd(motions[:, translations:])[2]
    return motions @ np.swapaxes(turns[:, ::-1], 1, 2)


def _gathered(comm: MPI.Intracomm, numbers: Numbers, rows: Vector) -> tuple[Numbers, Vector]:
    """Return numbers with a row each of all ranks."""
    whole, *columns = concatenate_buffers(comm, numbers.astype(np.int64), *rows.T)
    return whole, np.transpose(columns)


def _block_diagonal(blocks: Vector) -> sp.csr_matrix:
    """Return the block diagonal matrix of blocks (k, n, n), without zeros."""
    block, row, column = np.nonzero(blocks)
    size, n = blocks.shape[0] * blocks.shape[1], blocks.shape[1]
    where = (block * n + row, block * n + column)
    return sp.csr_matrix((blocks[block, row, column], where), shape=(size, size))


def _block_columns(vectors: Vector, chosen: NDArray[np.bool_]) -> sp.csr_matrix:
    """Return the block diagonal matrix of chosen columns of (bodies, modes, modes) vectors."""
    bodies, modes, _ = vectors.shape
    body, mode = np.nonzero(chosen)
    data = vectors[body, :, mode]
    row = body[:, None] * modes + np.arange(modes)
    column = np.broadcast_to(np.arange(body.size)[:, None], row.shape)
    shape = (bodies * modes, body.size)
    return sp.csr_matrix((data.ravel(), (row.ravel(), column.ravel())), shape=shape)


@dataclass(frozen=True)
class _Part:
    """A connected part of the Gram matrix with weak eigenvectors."""

    unknowns: Numbers  # (n,): rows of the Gram matrix
    columns: slice  # among the weak motions
    # (z, x (n, k)) -> inverse of the Gram matrix on the other eigenvectors, times x
    others: Callable[[Vector, Vector], Vector]


def _of_several_bodies(
    comm: MPI.Intracomm, B: sp.csr_matrix, E: sp.csr_matrix, below: float
) -> tuple[Vector, sp.csr_matrix]:
    """Return the weak motions among those that B and E resist, and the resistance of each."""
    springs = E.T @ E
    gram = (sum_sparse(comm, B.T @ B) + springs).tocsr()
    parts, blocks = list[_Part](), list[Vector]()
    number = 0
    for unknowns in _connected(gram):
        find = _by_dense_algebra if unknowns.size <= _LARGE else _by_inverse_iteration
        weak, others = find(gram[unknowns][:, unknowns], below**2)
        if weak.shape[1]:
            parts.append(_Part(unknowns, slice(number, number + weak.shape[1]), others))
            blocks.append(weak)
            number += weak.shape[1]
    if not parts:
        return np.zeros(0), sp.csr_matrix((gram.shape[0], 0))
    # eigenvectors of the Gram matrix have errors of 1e-16 / below^2; here nothing is squared
    for _ in range(_PASSES if below <= WEAK else 0):
        z = _assembled(parts, blocks, gram.shape[0])
        product = (sum_sparse(comm, B.T @ (B @ z)) + springs @ z).tocsr()
        for k, part in enumerate(parts):
            error = part.others(blocks[k], product[part.unknowns][:, part.columns].toarray())
            blocks[k] = np.linalg.qr(blocks[k] - error)[0]
    z = _dense_if_full(_assembled(parts, blocks, gram.shape[0]))
    Bz, Ez = B @ z, E @ z
    squares = sum_sparse(comm, sp.csr_matrix(Bz.T @ Bz)) + sp.csr_matrix(Ez.T @ Ez)
    resistance = np.zeros(number)
    for k, part in enumerate(parts):
        square = squares[part.columns][:, part.columns].toarray()
        values, vectors = np.linalg.eigh(square)
        resistance[part.columns] = np.sqrt(np.maximum(values, 0.0))
        blocks[k] = blocks[k] @ vectors
    return resistance, _assembled(parts, blocks, gram.shape[0])


_Eigenvectors = tuple[Vector, Callable[[Vector, Vector], Vector]]


def _by_dense_algebra(gram: sp.csr_matrix, limit: float) -> _Eigenvectors:
    """Return the eigenvectors with values up to a limit, and the inverse on the others."""
    values, vectors = np.linalg.eigh(gram.toarray())
    weak = values <= limit
    rest, stiffness = vectors[:, ~weak], values[~weak, None]
    return vectors[:, weak], lambda z, x: rest @ ((rest.T @ x) / stiffness)


def _by_inverse_iteration(gram: sp.csr_matrix, limit: float) -> _Eigenvectors:
    """As `_by_dense_algebra`, by the sparse factor of a slightly shifted matrix.

    The block grows until it has vectors with values far above the limit: then it has all of those
    below.
    """
    size = gram.shape[0]
    shifted = (gram + _SHIFT * limit * sp.identity(size)).tocsc()
    symmetric = {"SymmetricMode": True}
    factor = splu(shifted, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    number = _BLOCK
    while number < size // 4:
        x = np.random.default_rng(0).standard_normal((size, number))
        for _ in range(_ITERATIONS):
            x = np.linalg.qr(factor.solve(x))[0]
        values, vectors = np.linalg.eigh(x.T @ (gram @ x))
        if values[-1] > limit / _SHIFT:
            z = x @ vectors[:, values <= limit]
            return z, lambda z, x: _without(z, factor.solve(_without(z, x)))
        number *= 2
    return _by_dense_algebra(gram, limit)


def _without(z: Vector, x: Vector) -> Vector:
    """Return x without its part in the range of orthonormal columns z."""
    return x - z @ (z.T @ x)


def _assembled(parts: Sequence[_Part], blocks: Sequence[Vector], size: int) -> sp.csr_matrix:
    """Return the weak motions of all parts side by side."""
    row = [
        np.repeat(part.unknowns, block.shape[1]) for part, block in zip(parts, blocks, strict=True)
    ]
    column = [
        np.tile(np.arange(part.columns.start, part.columns.stop), len(block))
        for part, block in zip(parts, blocks, strict=True)
    ]
    data = np.concatenate([block.ravel() for block in blocks])
    where = (np.concatenate(row), np.concatenate(column))
    return sp.csr_matrix((data, where), shape=(size, parts[-1].columns.stop))


def _dense_if_full(matrix: sp.csr_matrix) -> sp.csr_matrix | Vector:
    """Return a matrix as an array where that makes its products cheaper."""
    full = matrix.nnz > _FULL * matrix.shape[0] * matrix.shape[1]
    return matrix.toarray() if full else matrix


def _connected(graph: sp.csr_matrix) -> list[Numbers]:
    """Return the unknowns of each connected part."""
    if not graph.shape[0]:
        return []
    number, part = connected_components(graph, directed=False)
    order = np.argsort(part, kind="stable")
    return np.split(order, np.searchsorted(part[order], np.arange(1, number)))


def sum_sparse(comm: MPI.Intracomm, part: sp.spmatrix) -> sp.csr_matrix:
    """Return the sum of the ranks' sparse matrices of one shape, the same on all ranks."""
    if comm.size == 1:
        return part.tocsr()
    coo = part.tocoo()
    row, column, data = concatenate_buffers(
        comm, coo.row.astype(np.int64), coo.col.astype(np.int64), coo.data.astype(np.float64)
    )
    return sp.csr_matrix((data, (row, column)), shape=part.shape)
