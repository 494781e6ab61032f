"""Subdomains of equal shape and stiffness share their operators, and are applied together.

Which are congruent is read off the matrices and coordinates, never assumed. A vector of all torn
unknowns, or of the packed boundary ones, is a matrix with a row for each subdomain of a class.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.torn_system import Subdomain

__all__ = ["Boundary", "Congruent", "apply_by_class", "find_congruent", "times_rows"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Real = TypeVar("Real", np.float32, np.float64)

# relative to the largest entry or to the size: what assembly at another place may change
_SAME = 1e-12
# digits of the fingerprint by which candidates are found; the comparison decides
_DIGITS = 8
# rows at once for a sparse matrix: their transposes stay in the cache
_ROWS = 64


@dataclass(frozen=True)
class Congruent:
    """Subdomains with the same stiffness matrix and, but for a translation, coordinates.

    Attributes
    ----------
    members : (k,) integer array
        Their positions among this rank's subdomains, ascending.
    starts : (k,) integer array
        First torn unknown of each.
    size : int
        Unknowns of each.
    """

    members: Numbers
    starts: Numbers
    size: int

    @property
    def first(self) -> int:
        """The subdomain that stands for all."""
        return int(self.members[0])

    def rows(self, torn: Vector) -> Vector:
        """Return the members' parts of a torn vector as the rows of a (k, n) matrix."""
        begin, end = int(self.starts[0]), int(self.starts[-1]) + self.size
        if end - begin == self.members.size * self.size:
            return torn[begin:end].reshape(-1, self.size)
        return torn[self.starts[:, None] + np.arange(self.size)]

    def put(self, torn: Vector, rows: Vector) -> None:
        """Write the rows back into a torn vector."""
        begin, end = int(self.starts[0]), int(self.starts[-1]) + self.size
        if end - begin == self.members.size * self.size:
            torn[begin:end] = rows.ravel()
        else:
            torn[self.starts[:, None] + np.arange(self.size)] = rows


def find_congruent(subdomains: Sequence[Subdomain]) -> list[Congruent]:
    """Sort subdomains into classes of congruent ones.

    Parameters
    ----------
    subdomains : sequence of Subdomain
        This rank's.

    Returns
    -------
    list of Congruent
        In the order of their first members.
    """
    starts = np.cumsum([0, *(s.size for s in subdomains)])[:-1]
    candidates: dict[int, list[list[int]]] = {}
    known: dict[int, int] = {}
    for i, subdomain in enumerate(subdomains):
        matrix = id(subdomain.stiffness)
        if matrix not in known:
            known[matrix] = _fingerprint(subdomain.stiffness)
        classes = candidates.setdefault(known[matrix], [])
        for members in classes:
            if _same(subdomain, subdomains[members[0]]):
                members.append(i)
                break
        else:
            classes.append([i])
    found = sorted(members for classes in candidates.values() for members in classes)
    return [
        Congruent(np.array(members), starts[members], subdomains[members[0]].size)
        for members in found
    ]


def _fingerprint(K: sp.csr_matrix) -> int:
    # sums over many entries, rounded: rarely at a rounding step, and then only sharing is lost
    scale = np.abs(K.data).max(initial=0.0)
    trace = K.diagonal().sum()
    digits = [f"{value:.{_DIGITS}e}" for value in (scale, trace)]
    return hash((K.shape, K.nnz, K.indices[:64].tobytes(), *digits))


def _same(one: Subdomain, other: Subdomain) -> bool:
    K, L = one.stiffness, other.stiffness
    if K is not L:
        if K.shape != L.shape or K.nnz != L.nnz:
            return False
        if not (np.array_equal(K.indptr, L.indptr) and np.array_equal(K.indices, L.indices)):
            return False
        if np.abs(K.data - L.data).max(initial=0.0) > _SAME * np.abs(L.data).max(initial=0.0):
            return False
    offset = one.coordinates - other.coordinates
    offset -= offset[:1]
    reach = max(np.abs(one.coordinates).max(initial=0.0), np.abs(other.coordinates).max(initial=0))
    return bool(np.abs(offset).max(initial=0.0) <= _SAME * reach)


def apply_by_class(
    classes: Sequence[Congruent], operators: Sequence[Callable[[Vector], Vector]], torn: Vector
) -> Vector:
    """Apply an operator (k, n) -> (k, n) to each class' rows of a torn vector."""
    result = np.empty_like(torn)
    for congruent, operator in zip(classes, operators, strict=True):
        congruent.put(result, operator(congruent.rows(torn)))
    return result


def times_rows(matrix: sp.csr_matrix, rows: Vector) -> Vector:
    """Return a (n, n) sparse matrix times each row of a (k, n) matrix."""
    if len(rows) == 1:
        return np.asarray(matrix @ rows[0])[None]
    product = np.empty_like(rows)
    for start in range(0, len(rows), _ROWS):
        some = slice(start, start + _ROWS)
        product[some] = (matrix @ rows[some].T).T
    return product


@dataclass(frozen=True)
class Boundary:
    """The torn unknowns that B acts on, packed: class by class, subdomain by subdomain.

    Attributes
    ----------
    classes : sequence of Congruent
        The classes.
    unknowns : list of integer arrays
        For each class the unknowns of a subdomain on which B has an entry, for any member.
    columns : (b,) integer array
        The torn unknown of each packed one.
    matrix : (m, b) scipy.sparse.csr_matrix
        The columns of B.
    transposed : (b, m) scipy.sparse.csr_matrix
        The same by rows of B': a product that gathers moves less memory than one that scatters.
    """

    classes: Sequence[Congruent]
    unknowns: list[Numbers]
    columns: Numbers
    matrix: sp.csr_matrix
    transposed: sp.csr_matrix

    @staticmethod
    def build(matrix: sp.csr_matrix, classes: Sequence[Congruent]) -> Boundary:
        """Pack the columns of B, a (m, n) matrix of all torn unknowns."""
        touched = np.zeros(matrix.shape[1], dtype=bool)
        touched[matrix.indices] = True
        unknowns = [np.flatnonzero(c.rows(touched).any(axis=0)) for c in classes]
        columns = np.concatenate(
            [
                np.zeros(0, dtype=np.int64),
                *(
                    (c.starts[:, None] + local).ravel()
                    for c, local in zip(classes, unknowns, strict=True)
                ),
            ]
        )
        place = np.zeros(matrix.shape[1], dtype=matrix.indices.dtype)
        place[columns] = np.arange(columns.size, dtype=place.dtype)
        packed = sp.csr_matrix(
            (matrix.data, place[matrix.indices], matrix.indptr),
            shape=(matrix.shape[0], columns.size),
        )
        return Boundary(classes, unknowns, columns, packed, packed.T.tocsr())

    def in_single_precision(self) -> Boundary:
        """Return the same with float32 entries of B; the patterns are shared."""
        matrix, transposed = (
            sp.csr_matrix((B.data.astype(np.float32), B.indices, B.indptr), shape=B.shape)
            for B in (self.matrix, self.transposed)
        )
        return replace(self, matrix=matrix, transposed=transposed)

    def blocks(self, packed: NDArray[Real]) -> list[NDArray[Real]]:
        """Return a packed vector as matrices (k, boundary unknowns), one for each class."""
        sizes = [c.members.size * u.size for c, u in zip(self.classes, self.unknowns, strict=True)]
        parts = np.split(packed, np.cumsum(sizes)[:-1]) if sizes else []
        return [
            part.reshape(c.members.size, u.size)
            for part, c, u in zip(parts, self.classes, self.unknowns, strict=True)
        ]

    def apply(
        self, operators: Sequence[Callable[[NDArray[Real]], NDArray[Real]]], packed: NDArray[Real]
    ) -> NDArray[Real]:
        """Apply an operator (k, b) -> (k, b) to each class' block of a packed vector."""
        return self.pack(
            [op(block) for op, block in zip(operators, self.blocks(packed), strict=True)]
        )

    def pack(self, blocks: Sequence[NDArray[Real]]) -> NDArray[Real]:
        """Return the matrices (k, boundary unknowns) of the classes as a packed vector."""
        if len(blocks) == 1:
            return blocks[0].ravel()
        none = np.zeros(0, dtype=self.matrix.dtype)
        return np.concatenate([none, *(block.ravel() for block in blocks)])
