"""Subdomains of equal shape and stiffness share their operators, and are applied together.

Which are congruent is read off the matrices and coordinates, never assumed. A vector of all torn
unknowns, or of the packed interface ones, is a matrix with a row for each subdomain of a class.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.tolerances import ZERO_ENERGY

__all__ = ["CongruenceClass", "apply_by_class", "find_congruence_classes", "times_rows"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# relative to the largest entry or to the size: what assembly at another place may change
_SAME = 1e-12
# digits of the fingerprint by which candidates are found; the comparison decides
_DIGITS = 8
# rows at once for a sparse matrix: their transposes stay in the cache
_ROWS = 64


@dataclass(frozen=True)
class CongruenceClass:
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


def find_congruence_classes(subdomains: Sequence[Subdomain]) -> list[CongruenceClass]:
    """Sort subdomains into classes of congruent ones.

    Parameters
    ----------
    subdomains : sequence of Subdomain
        This rank's.

    Returns
    -------
    list of CongruenceClass
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
        CongruenceClass(np.array(members), starts[members], subdomains[members[0]].size)
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
        difference, largest = K.data - L.data, np.abs(L.data).max(initial=0.0)
        if np.abs(difference).max(initial=0.0) > _SAME * largest:
            return False
        # a soft elastic support changes no entry by more, but the energies of rigid motions
        change = sp.csr_matrix((difference, K.indices, K.indptr), shape=K.shape)
        R = rigid_body_modes(one.coordinates)
        if np.abs(R.T @ (change @ R)).max(initial=0.0) > ZERO_ENERGY * largest:
            return False
    offset = one.coordinates - other.coordinates
    offset -= offset[:1]
    reach = max(np.abs(one.coordinates).max(initial=0.0), np.abs(other.coordinates).max(initial=0))
    return bool(np.abs(offset).max(initial=0.0) <= _SAME * reach)


def apply_by_class(
    classes: Sequence[CongruenceClass],
    operators: Sequence[Callable[[Vector], Vector]],
    torn: Vector,
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
