"""Equality rows: gluing rows of free components, Dirichlet rows of prescribed ones.

A node with k copies gets k - 1 contrasts for each free component and k rows with a single entry for
each prescribed one, all orthonormal in D^{-1}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class EqualityRows:
    """The equality rows of this rank's copies.

    Attributes
    ----------
    entries : Entries
        Their entries on this rank.
    prescribed : (p,) integer array
        Global numbers of the Dirichlet rows.
    values : (p,) array
        Their right-hand sides; those of gluing rows are zero.
    """

    entries: Entries
    prescribed: Numbers
    values: Vector


@dataclass(frozen=True)
class _Chain:
    """The copies, on all ranks, of the nodes held here: ordered within their node.

    Attributes
    ----------
    node : (c,) integer array
        Position in the nodes held here.
    number : (c,) integer array
        0, 1, ..., k - 1 within the node.
    own : (c,) integer array
        The copy on this rank; -1 for copies on other ranks.
    weight : (c,) array
        Entry of D.
    before : (c,) array
        Sum of the weights of the node's preceding copies.
    """

    node: Numbers
    number: Numbers
    own: Numbers
    weight: Vector
    before: Vector


def equality_rows(
    directory: Directory, copies: Copies, local: NodeTable, gdim: int, rank: int
) -> EqualityRows:
    """Return the gluing and Dirichlet rows of this rank's copies. Collective.

    Parameters
    ----------
    directory : Directory
        Of the nodes.
    copies : Copies
        This rank's copies of nodes with such rows.
    local : NodeTable
        The table of the nodes of these copies.
    gdim, rank : int
        Components of a displacement; this rank.
    """
    chain = _chain(directory, copies, rank)
    here = chain.own >= 0
    number = np.empty(copies.node.size, dtype=np.int64)
    number[chain.own[here]] = chain.number[here]
    contrasts = _contrasts(chain, local.multiplicity)
    multiplicity, row = local.multiplicity[copies.node], local.first_row[copies.node]
    parts: list[Entries] = []
    prescribed_rows: list[Numbers] = []
    values: list[Vector] = []
    for component in range(gdim):
        prescribed = local.prescribed[copies.node, component]
        unknown = copies.unknown + component

        rows, root = (row + number)[prescribed], np.sqrt(copies.weight[prescribed])
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
    own = np.arange(copies.node.size)
    keys, ranks, own, weight = directory.forward(
        copies.nodes[copies.node], np.full(own.size, rank, dtype=np.int64), own, copies.weight
    )
    order = np.lexsort((own, ranks, keys))
    keys, ranks, own, weight = keys[order], ranks[order], own[order], weight[order]
    node = np.searchsorted(copies.nodes, keys)
    number = np.arange(keys.size) - np.searchsorted(keys, keys)
    before = np.zeros(keys.size)
    for r in range(1, int(number.max(initial=0)) + 1):
        at = np.flatnonzero(number == r)
        before[at] = before[at - 1] + weight[at - 1]
    return _Chain(node, number, np.where(ranks == rank, own, -1), weight, before)


def _contrasts(chain: _Chain, multiplicity: Numbers) -> Entries:
    """Contrasts c_r with c_r D^{-1} c_s' = delta_rs: copy r against the mean of the copies before.

    With weights d_0, d_1, ... and s_r = d_0 + ... + d_{r-1}, row r = 1, ..., k - 1 is
    (d_0, ..., d_{r-1}, -s_r, 0, ..., 0) / s_r / sqrt(1 / s_r + 1 / d_r); Helmert's for weights 1.

    Returns
    -------
    Entries
        Rows counted from 0 within the node, columns as copies on this rank.
    """
    mine = np.flatnonzero(chain.own >= 0)
    number = chain.number[mine]
    first = np.maximum(number, 1)
    rows_of_copy = multiplicity[chain.node[mine]] - first
    term = np.repeat(np.arange(mine.size), rows_of_copy)
    start = np.cumsum(rows_of_copy) - rows_of_copy
    r = (np.arange(term.size) - start[term] + first[term]).astype(np.int64)
    of_row = mine[term] - number[term] + r  # position of copy r in the chain
    s, d = chain.before[of_row], chain.weight[of_row]
    values = np.where(r == number[term], -1.0, chain.weight[mine[term]] / s)
    return Entries(r - 1, chain.own[mine[term]], values / np.sqrt(1.0 / s + 1.0 / d))
