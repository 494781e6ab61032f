"""The parts of the user's mesh that are subdomains, with equal node numbers where congruent."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING

__all__ = ["Part", "find_equal", "number_parts"]

Indices = NDArray[np.int32]
Points = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """The cells of a subdomain, and the numbers of their nodes within it.

    Attributes
    ----------
    cells : (m,) integer array
        The cells of the user's mesh.
    nodes : (k,) integer array
        Blocked degrees of freedom of the user's space, in the order of the subdomain's nodes.
    table : (m, v) integer array
        The nodes of each cell, numbered within the subdomain.
    body : int
        The body.
    shape : bytes or None
        Hash of the table and of the nodes' relative coordinates, equal for congruent parts; None
        where no other part has as many cells and nodes.
    """

    cells: Indices
    nodes: Indices
    table: Indices
    body: int
    shape: bytes | None = None


def number_parts(
    space: FunctionSpace, cells: Sequence[Indices], bodies: Sequence[int]
) -> list[Part]:
    """Give the nodes of each subdomain numbers within it.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    cells : sequence of integer arrays
        Cells of each of this rank's subdomains.
    bodies : sequence of int
        The body of each.

    Returns
    -------
    list of Part
        Where parts have equally many cells and nodes, both are sorted in an order that depends on
        their shape alone: congruent parts have equal tables.
    """
    dofs = _compat.cell_dofs(space)
    x = space.tabulate_dof_coordinates()[:, : space.mesh.geometry.dim]
    parts = [_number(dofs, own, body) for own, body in zip(cells, bodies, strict=True)]
    alike: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        alike[part.cells.size, part.nodes.size].append(i)
    for candidates in alike.values():
        if len(candidates) > 1:
            for i in candidates:
                parts[i] = _sort(parts[i], x[parts[i].nodes])
    return parts


def find_equal(
    parts: Sequence[Part], x: Points, data: Sequence[NDArray[Any]], translation_invariant: bool
) -> list[int]:
    """Find parts that are equal in shape and data.

    Parameters
    ----------
    parts : sequence of Part
        This rank's parts.
    x : (dofs, gdim) array
        Coordinates of the blocked degrees of freedom of the user's space [m].
    data : sequence of (cells, ...) arrays
        Data of each cell of the user's mesh that have to be equal, bit by bit.
    translation_invariant : bool
        False: no two parts are equal, since they lie at different places.

    Returns
    -------
    list of int
        For each part the first one that is equal to it, possibly itself.
    """
    first = list(range(len(parts)))
    if not translation_invariant:
        return first
    known: dict[bytes, list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        if part.shape is None:
            continue
        # the hash stands for the data; coordinates are rounded in it and therefore compared
        candidates = known[part.shape + _hash(*(values[part.cells] for values in data))]
        for j in candidates:
            if _is_translated(x[part.nodes], x[parts[j].nodes]):
                first[i] = j
                break
        else:
            candidates.append(i)
    return first


def _number(dofs: Indices, cells: Indices, body: int) -> Part:
    nodes, table = np.unique(dofs[cells], return_inverse=True)
    return Part(cells, nodes, table.reshape(cells.size, -1).astype(np.int32), body)


def _sort(part: Part, x: Points) -> Part:
    """Sort the nodes by their coordinates relative to the part, and the cells by their nodes."""
    # Coordinates are rounded to steps in the width of the part. Their number is a power of two, so
    # that no regular grid has nodes half-way between two steps; a part whose node is there by
    # chance is assembled by itself.
    steps = 2**30
    relative = x - x.min(axis=0)
    rounded = np.rint(relative * (steps / relative.max())).astype(np.int64)
    order = np.lexsort(rounded.T)
    rank = np.empty(order.size, dtype=np.int32)
    rank[order] = np.arange(order.size, dtype=np.int32)
    table = rank[part.table]
    rows = np.lexsort(table.T)
    shape = _hash(rounded[order], table[rows])
    return Part(part.cells[rows], part.nodes[order], table[rows], part.body, shape)


def _hash(*data: NDArray[Any]) -> bytes:
    digest = hashlib.sha256()
    for values in data:
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.digest()


def _is_translated(one: Points, other: Points) -> bool:
    """Tell whether two parts' nodes differ by a translation, up to the rounding of coordinates."""
    offset = one - other
    offset -= offset[:1]
    largest = max(np.abs(one).max(), np.abs(other).max())
    return bool(np.abs(offset).max() <= COORDINATE_ROUNDING * largest)
