"""Equality rows: gluing rows of free components, Dirichlet rows of prescribed ones.

A node with k copies gets k - 1 contrasts for each free component and k rows with a single entry for
each prescribed one, all orthonormal in D^{-1}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable
from fenics_tfeti.feti.constraints.scaling import unit_scale
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class EqualityRows:
    """The equality rows of this rank's copies."""

    entries: Entries  # on this rank
    prescribed: Numbers  # (p,): global numbers of the Dirichlet rows
    values: Vector  # (p,): their right-hand sides; those of gluing rows are zero


@dataclass(frozen=True)
class _Chain:
    """The copies, on all ranks, of this rank's nodes, numbered 0, 1, ... within their node.

    `copy` is the position of a copy among those of this rank, -1 for copies of other ranks, and
    `weight_before` the sum of the weights of the node's preceding copies.
    """

    node: Numbers
    number: Numbers
    copy: Numbers
    weight: Vector
    weight_before: Vector


def equality_rows(
    directory: Directory, copies: Copies, local: NodeTable, gdim: int, rank: int
) -> EqualityRows:
    """Return the gluing and Dirichlet rows of this rank's copies. Collective.

    `copies` are those of nodes with such rows, `local` is the table of these nodes.
    """
    chain = _chain(directory, copies, rank)
    local_copies = chain.copy >= 0
    number = np.empty(copies.node.size, dtype=np.int64)
    number[chain.copy[local_copies]] = chain.number[local_copies]
    contrasts = _contrasts(chain, local.multiplicity)
    multiplicity, row = local.multiplicity[copies.node], local.first_row[copies.node]
    parts: list[Entries] = []
    prescribed_rows: list[Numbers] = []
    values: list[Vector] = []
    for component in range(gdim):
        prescribed = local.prescribed[copies.node, component]
        unknown = copies.unknown + component

        rows, root = (row + number)[prescribed], unit_scale(1.0 / copies.weight[prescribed])
        parts.append(Entries(rows, unknown[prescribed], root))
        prescribed_rows.append(rows)
        values.append(root * local.values[copies.node[prescribed], component])

        glued = ~prescribed[contrasts.columns]
        copy = contrasts.columns[glued]
        parts.append(
            Entries(row[copy] + contrasts.rows[glued], unknown[copy], contrasts.values[glued])
        )
        row = row + np.where(prescribed, multiplicity, multiplicity - 1)
    return EqualityRows(
        Entries.concatenate(parts), np.concatenate(prescribed_rows), np.concatenate(values)
    )


def _chain(directory: Directory, copies: Copies, rank: int) -> _Chain:
    """Order the copies of all ranks, in the same way on all ranks."""
    copy = np.arange(copies.node.size)
    keys, ranks, copy, weight = directory.forward(
        copies.nodes[copies.node], np.full(copy.size, rank, dtype=np.int64), copy, copies.weight
    )
    order = np.lexsort((copy, ranks, keys))
    keys, ranks, copy, weight = keys[order], ranks[order], copy[order], weight[order]
    node = np.searchsorted(copies.nodes, keys)
    number = np.arange(keys.size) - np.searchsorted(keys, keys)
    weight_before = np.zeros(keys.size)
    for r in range(1, int(number.max(initial=0)) + 1):
        position = np.flatnonzero(number == r)
        weight_before[position] = weight_before[position - 1] + weight[position - 1]
    return _Chain(node, number, np.where(ranks == rank, copy, -1), weight, weight_before)


def _contrasts(chain: _Chain, multiplicity: Numbers) -> Entries:
    """Contrasts c_r with c_r D^{-1} c_s' = delta_rs: copy r against the mean of the copies before.

    With weights d_0, d_1, ... and s_r = d_0 + ... + d_{r-1}, row r = 1, ..., k - 1 is
    (d_0, ..., d_{r-1}, -s_r, 0, ..., 0) / s_r / sqrt(1 / s_r + 1 / d_r); Helmert's for weights 1.
    Rows are counted from 0 within the node, columns are copies on this rank.
    """
    local = np.flatnonzero(chain.copy >= 0)
    number = chain.number[local]
    first = np.maximum(number, 1)
    rows_of_copy = multiplicity[chain.node[local]] - first
    term = np.repeat(np.arange(local.size), rows_of_copy)
    start = np.cumsum(rows_of_copy) - rows_of_copy
    r = (np.arange(term.size) - start[term] + first[term]).astype(np.int64)
    new = local[term] - number[term] + r  # position of copy r in the chain
    s, d = chain.weight_before[new], chain.weight[new]
    values = np.where(r == number[term], -1.0, chain.weight[local[term]] / s)
    return Entries(r - 1, chain.copy[local[term]], values * unit_scale(1.0 / s + 1.0 / d))
