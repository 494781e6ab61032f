"""The interface: the torn unknowns that B acts on, packed by classes of congruent subdomains.

Packed vectors are in the frames of the subdomains.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.local.congruence import CongruenceClass
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class Interface:
    """The torn unknowns that B acts on, packed: class by class, subdomain by subdomain."""

    classes: Sequence[CongruenceClass]
    # for each class those of a subdomain with an entry of B for any member; with frames whole nodes
    unknowns: list[Numbers]
    columns: Numbers  # (b,): torn unknown of each packed one; with frames, the node counts
    matrix: sp.csr_matrix  # (m, b): columns of B; those of a subdomain with the frame T times T
    # (b, m): B' by rows, as a product that gathers moves less memory than one that scatters
    transposed: sp.csr_matrix

    @staticmethod
    def build(matrix: sp.csr_matrix, classes: Sequence[CongruenceClass]) -> Interface:
        """Pack the columns of B, a (m, n) matrix of all torn unknowns."""
        touched = np.zeros(matrix.shape[1], dtype=bool)
        touched[matrix.indices] = True
        unknowns = [_touched(c, touched) for c in classes]
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
        if any(c.frames is not None for c in classes):
            packed = (packed @ _turns(classes, unknowns)).tocsr()
        return Interface(classes, unknowns, columns, packed, packed.T.tocsr())

    @property
    def ends(self) -> Numbers:
        """First packed unknown of each subdomain, class by class, and the end of the last."""
        sizes = [
            np.full(c.members.size, u.size, dtype=np.int64)
            for c, u in zip(self.classes, self.unknowns, strict=True)
        ]
        return np.cumsum(np.concatenate([np.zeros(1, dtype=np.int64), *sizes]))

    def blocks(self, packed: Vector) -> list[Vector]:
        """Return a packed vector as matrices (k, interface unknowns), one for each class."""
        return [packed[part].reshape(shape) for part, shape in self._parts]

    @cached_property
    def _parts(self) -> list[tuple[slice, tuple[int, int]]]:
        """Where the block of each class is in a packed vector, and its shape."""
        parts, end = list[tuple[slice, tuple[int, int]]](), 0
        for c, u in zip(self.classes, self.unknowns, strict=True):
            begin, end = end, end + c.members.size * u.size
            parts.append((slice(begin, end), (c.members.size, u.size)))
        return parts

    def apply(self, operators: Sequence[Callable[[Vector], Vector]], packed: Vector) -> Vector:
        """Apply an operator (k, b) -> (k, b) to each class' block of a packed vector."""
        return self.pack(
            [op(block) for op, block in zip(operators, self.blocks(packed), strict=True)]
        )

    def pack(self, blocks: Sequence[Vector]) -> Vector:
        """Return the matrices (k, interface unknowns) of the classes as a packed vector."""
        if len(blocks) == 1:
            return blocks[0].ravel()
        return np.concatenate([np.zeros(0), *[block.ravel() for block in blocks]])


def _touched(congruent: CongruenceClass, touched: NDArray[np.bool_]) -> Numbers:
    unknowns = np.flatnonzero(touched[congruent.places].any(axis=0))
    return unknowns if congruent.frames is None else congruent.frames.whole_nodes(unknowns)


def _turns(classes: Sequence[CongruenceClass], unknowns: Sequence[Numbers]) -> sp.csr_matrix:
    """Return T on the packed unknowns."""
    blocks = [
        sp.identity(c.members.size * local.size) if c.frames is None else c.frames.matrix(local)
        for c, local in zip(classes, unknowns, strict=True)
    ]
    return sp.block_diag(blocks, format="csr")
