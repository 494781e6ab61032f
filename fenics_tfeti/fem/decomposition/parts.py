"""Subdomains as parts of the user's mesh, numbered alike where their shapes are equal."""

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

__all__ = ["Part", "find_equal", "number_parts"]

Numbers = NDArray[np.int32]
Points = NDArray[np.float64]

# relative to the coordinates: what rounding leaves when equal cells lie at different places
_ROUNDING = 1e-14
# Steps in the width of a part by which its nodes are sorted and fingerprinted. A power of two, so
# that no regular grid has its nodes half-way between two steps; where a node lies there by chance,
# only sharing is lost.
_STEPS = 2**30


@dataclass(frozen=True)
class Part:
    """A subdomain's cells, and the numbers of their nodes within it.

    Attributes
    ----------
    cells : (m,) integer array
        The user's cells.
    nodes : (k,) integer array
        The user's blocked degrees of freedom, in the order of the subdomain's nodes.
    table : (m, v) integer array
        The subdomain's nodes of each cell.
    body : int
        The body.
    shape : bytes or None
        Fingerprint of the table and of the nodes' places relative to each other, the same for
        congruent parts; None where no other part has as many cells and nodes.
    """

    cells: Numbers
    nodes: Numbers
    table: Numbers
    body: int
    shape: bytes | None = None


def number_parts(
    space: FunctionSpace, cells: Sequence[Numbers], bodies: Sequence[int]
) -> list[Part]:
    """Give the nodes of each subdomain numbers of its own.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's.
    cells : sequence of integer arrays
        Cells of each of this rank's subdomains.
    bodies : sequence of int
        The body of each.

    Returns
    -------
    list of Part
        Those that may be congruent with cells and nodes in an order that depends on their shape
        alone, so that congruent ones have equal tables.
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
    parts: Sequence[Part], x: Points, data: Sequence[NDArray[Any]], at_any_place: bool
) -> list[int]:
    """Find parts that are equal in shape and data.

    Parameters
    ----------
    parts : sequence of Part
        This rank's.
    x : (dofs, gdim) array
        Places of the user's blocked degrees of freedom [m].
    data : sequence of (cells, ...) arrays
        What else has to be equal, bit by bit, for each of the user's cells.
    at_any_place : bool
        False: where parts lie matters too, so that none is equal to another.

    Returns
    -------
    list of int
        For each part the first one that it equals, itself if there is none before.
    """
    first = list(range(len(parts)))
    if not at_any_place:
        return first
    known: dict[bytes, list[int]] = defaultdict(list)
    for i, part in enumerate(parts):
        if part.shape is None:
            continue
        # equal hashes are equal data; coordinates are rounded in it, and compared
        candidates = known[part.shape + _digest(*(values[part.cells] for values in data))]
        for j in candidates:
            if _is_translated(x[part.nodes], x[parts[j].nodes]):
                first[i] = j
                break
        else:
            candidates.append(i)
    return first


def _number(dofs: Numbers, cells: Numbers, body: int) -> Part:
    nodes, table = np.unique(dofs[cells], return_inverse=True)
    return Part(cells, nodes, table.reshape(cells.size, -1).astype(np.int32), body)


def _sort(part: Part, x: Points) -> Part:
    """Sort nodes by their places relative to the part, and cells by their nodes."""
    relative = x - x.min(axis=0)
    steps = np.rint(relative * (_STEPS / relative.max())).astype(np.int64)
    order = np.lexsort(steps.T)
    rank = np.empty(order.size, dtype=np.int32)
    rank[order] = np.arange(order.size, dtype=np.int32)
    table = rank[part.table]
    rows = np.lexsort(table.T)
    shape = _digest(steps[order], table[rows])
    return Part(part.cells[rows], part.nodes[order], table[rows], part.body, shape)


def _digest(*data: NDArray[Any]) -> bytes:
    found = hashlib.sha256()
    for values in data:
        found.update(f"{values.dtype} {values.shape}".encode())
        found.update(values.tobytes())
    return found.digest()


def _is_translated(one: Points, other: Points) -> bool:
    offset = one - other
    offset -= offset[:1]
    reach = max(np.abs(one).max(), np.abs(other).max())
    return bool(np.abs(offset).max() <= _ROUNDING * reach)
