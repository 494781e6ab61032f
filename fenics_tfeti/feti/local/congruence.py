"""Subdomains of equal shape and stiffness share their operators, and are applied together.

Which are congruent is read off the matrices and coordinates, never assumed. Rotated and mirrored
ones are congruent in their frames, see `Subdomain.frame`; the operators are those in the frame. A
vector of all torn unknowns, or of the packed interface ones, is a matrix with a row for each
subdomain of a class.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.costs import DENSE, ROWS
from fenics_tfeti.feti.local.frames import Frames
from fenics_tfeti.feti.local.rigid_body_modes import rigid_body_modes
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.feti.tolerances import ENERGY, GIVEN, rounding
from fenics_tfeti.typing import Numbers, Vector

T = TypeVar("T")

# digits of the fingerprint by which candidates are found; the comparison decides
_DIGITS = 8


@dataclass(frozen=True)
class CongruenceClass:
    """Subdomains with the same stiffness and coordinates, but for translations, in their frames."""

    members: Numbers  # (k,): positions among this rank's subdomains, ascending
    starts: Numbers  # (k,): first torn unknown of each
    size: int  # unknowns of each
    frames: Frames | None = None  # of the members, if they have any

    @property
    def first(self) -> int:
        """The subdomain that stands for all."""
        return int(self.members[0])

    @property
    def places(self) -> Numbers:
        """The torn unknowns of each member, (k, n)."""
        return self.starts[:, None] + np.arange(self.size)

    @property
    def _range(self) -> slice | None:
        """The range of the members' unknowns, if nothing is between them."""
        begin, end = int(self.starts[0]), int(self.starts[-1]) + self.size
        return slice(begin, end) if end - begin == self.members.size * self.size else None

    def batches(self) -> Iterator[CongruenceClass]:
        """Yield its members a few at a time: what is computed of them stays in the cache."""
        for start in range(0, self.members.size, ROWS):
            batch = slice(start, start + ROWS)
            frames = None if self.frames is None else self.frames[batch]
            yield CongruenceClass(self.members[batch], self.starts[batch], self.size, frames)

    def rows(self, torn: Vector) -> Vector:
        """Return the members' parts of a torn vector, in their frames, as rows of a matrix."""
        span = self._range
        rows = torn[self.places] if span is None else torn[span].reshape(-1, self.size)
        return rows if self.frames is None else self.frames.to_frame(rows)

    def put(self, torn: Vector, rows: Vector) -> None:
        """Write the rows back into a torn vector."""
        span = self._range
        if self.frames is not None:
            rows = self.frames.from_frame(rows)
        if span is None:
            torn[self.places] = rows
        else:
            torn[span] = rows.ravel()


def find_congruence_classes(subdomains: Sequence[Subdomain]) -> list[CongruenceClass]:
    """Sort this rank's subdomains into classes of congruent ones, in the order of first members."""
    starts = np.cumsum([0, *(s.size for s in subdomains)])[:-1]
    candidates: dict[int, list[list[int]]] = {}
    fingerprints: dict[int, int] = {}
    for i, subdomain in enumerate(subdomains):
        matrix = id(subdomain.stiffness)
        if matrix not in fingerprints:
            fingerprints[matrix] = _fingerprint(subdomain.stiffness)
        classes = candidates.setdefault(fingerprints[matrix], [])
        for members in classes:
            if _same(subdomain, subdomains[members[0]]):
                members.append(i)
                break
        else:
            classes.append([i])
    groups = sorted(members for classes in candidates.values() for members in classes)
    return [
        CongruenceClass(
            np.array(members),
            starts[members],
            subdomains[members[0]].size,
            _frames([subdomains[i] for i in members]),
        )
        for members in groups
    ]


def _frames(members: Sequence[Subdomain]) -> Frames | None:
    if all(member.frame is None for member in members):
        return None
    nodes, gdim = members[0].coordinates.shape
    turns = [np.eye(gdim) if member.frame is None else member.frame for member in members]
    return Frames(np.array(turns), nodes)


def _fingerprint(K: sp.csr_matrix) -> int:
    # sums over many entries, rounded: rarely at a rounding step, and then only sharing is lost
    sizes = np.abs(K.data)
    digits = [f"{value:.{_DIGITS}e}" for value in (sizes.max(initial=0.0), sizes.sum())]
    return hash((K.shape, K.nnz, K.indices[:64].tobytes(), *digits))


def _same(first: Subdomain, second: Subdomain) -> bool:
    if not first.has_kernel_of(second):
        return False
    K, L = first.stiffness, second.stiffness
    if K is not L:
        if not (np.array_equal(K.indptr, L.indptr) and np.array_equal(K.indices, L.indices)):
            return False
        change = sp.csr_matrix((K.data - L.data, K.indices, K.indptr), shape=K.shape)
        if not is_rounding(change, L, first.coordinates_in_frame):
            return False
    offset = first.coordinates_in_frame - second.coordinates_in_frame
    offset -= offset[:1]
    reach = max(
        np.abs(first.coordinates).max(initial=0.0), np.abs(second.coordinates).max(initial=0)
    )
    return bool(np.abs(offset).max(initial=0.0) <= rounding(reach, GIVEN))


def is_rounding(change: sp.csr_matrix, stiffness: sp.csr_matrix, coordinates: Vector) -> bool:
    """Tell whether a change of a stiffness matrix is but rounding.

    The change and the stiffness (n, n) are in [N/m], the coordinates (nodes, gdim) in [m].
    """
    largest = np.abs(stiffness.data).max(initial=0.0)
    # assembly at another place may change as much
    if np.abs(change.data).max(initial=0.0) > rounding(largest, GIVEN):
        return False
    # a soft elastic support changes no entry by more, but the energies of rigid motions
    R = rigid_body_modes(coordinates)
    return bool(np.abs(R.T @ (change @ R)).max(initial=0.0) <= rounding(largest, ENERGY))


def of_subdomains(classes: Sequence[CongruenceClass], values: Sequence[T]) -> list[T]:
    """Return for each subdomain, class by class, the value of its class."""
    return [
        value for congruent, value in zip(classes, values, strict=True) for _ in congruent.members
    ]


def apply_by_class(
    classes: Sequence[CongruenceClass],
    operators: Sequence[Callable[[Vector], Vector]],
    torn: Vector,
) -> Vector:
    """Apply an operator (k, n) -> (k, n) to each class' rows of a torn vector, k at a time."""
    result = np.empty_like(torn)
    for congruent, operator in zip(classes, operators, strict=True):
        for batch in congruent.batches():
            batch.put(result, operator(batch.rows(torn)))
    return result


def dense_if_small(matrix: sp.spmatrix) -> sp.spmatrix | Vector:
    """Return a matrix for products with vectors: a dense one if it is small."""
    return matrix.toarray() if matrix.shape[0] * matrix.shape[1] <= DENSE else matrix


def times_rows(matrix: sp.csr_matrix | Vector, rows: Vector) -> Vector:
    """Return a (n, n) matrix, dense or sparse, times each row of a (k, n) matrix."""
    if isinstance(matrix, np.ndarray):
        return rows @ matrix.T
    if len(rows) == 1:
        return np.asarray(matrix @ rows[0])[None]
    product = np.empty_like(rows)
    for start in range(0, len(rows), ROWS):
        block = slice(start, start + ROWS)
        product[block] = (matrix @ rows[block].T).T
    return product
