"""Moments of tractions that balance the forces of all cells around each node.

Around a node, each cell has a force r, and each facet a moment m for its shape function there, with
opposite signs on both sides. Sought are the moments nearest to given ones with r + sum of m = 0 for
each cell. Their multipliers solve the graph Laplacian of the cells around the node, which facets
join; facets with one cell hold it. Cells that none holds are in balance with each other, or are
told of.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from fenics_tfeti.fem.mesh_error.cell_loops import balance_nodes, ordered
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.parallel import send_rows
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector


@dataclass(frozen=True)
class CellForces:
    """Forces of p cells at nodes: a row for each node of each cell."""

    node: Numbers  # (p,) global
    cell: Numbers  # (p,) global
    force: Vector  # (p, d, v): of v load cases [N]


@dataclass(frozen=True)
class FacetMoments:
    """Moments on t facets of cells at nodes, from the side of the cell."""

    node: Numbers  # (t,) global
    cell: Numbers  # (t,) global
    facet: Numbers  # (t,) global
    free: Mask  # (t, d): others are zero
    moment: Vector  # (t, d) [N]


def balanced_moments(forces: CellForces, moments: FacetMoments) -> tuple[Vector, Numbers, Vector]:
    """Return the moments (t, d, v) in balance, and what is out of balance at nodes.

    The imbalance is that of the cells around a node that nothing holds [N]: the nodes (p,), and in
    each the forces (p, d).
    """
    nodes, keys = np.unique(forces.node, return_inverse=True)
    in_order = np.lexsort((forces.cell, forces.node))
    sorted_rows = forces.node[in_order], forces.cell[in_order]
    pair = in_order[_positions(*sorted_rows, moments.node, moments.cell)]
    # the rows of the moments of each pair
    by_pair = np.argsort(pair, kind="stable")
    counts = np.bincount(pair, minlength=keys.size)
    slots = np.arange(pair.size) - np.repeat(np.cumsum(counts) - counts, counts)
    offset = np.full((keys.size, int(counts.max(initial=1))), -1)
    offset[pair[by_pair], slots] = by_pair
    _, facet = np.unique(moments.facet, return_inverse=True)
    out = np.zeros((*moments.moment.shape, forces.force.shape[2]))
    imbalance = balance_nodes(
        np.zeros(nodes.size, dtype=bool),
        ordered(keys, nodes.size),
        (max(1, keys.size), 0, offset),
        (1, facet, moments.free),
        forces.force,
        np.ascontiguousarray(moments.moment),
        out,
    )
    return out, nodes, imbalance


def moments_over_ranks(
    nodes: NodeMap, forces: CellForces, moments: FacetMoments
) -> tuple[Vector, Numbers, Vector]:
    """Return the same where nodes have cells on several ranks; nodes are owned ones. Collective."""
    forces_there, _ = _to_owners(nodes, forces)
    moments_there, sender = _to_owners(nodes, moments)
    solved, node, missing = balanced_moments(forces_there, moments_there)
    # rows of a sender come back in the order in which it has sent them
    (back,) = send_rows(nodes.comm, sender, solved)
    result = np.empty_like(back)
    result[np.argsort(nodes.owners(moments.node), kind="stable")] = back
    return result, node, missing


def on_several_ranks(nodes: NodeMap, used: Indices) -> Mask:
    """Tell which local nodes have cells on several ranks; this one's use some. Collective."""
    if nodes.comm.size == 1:
        return np.zeros(nodes.size, dtype=bool)
    distinct = nodes.to_global(np.unique(used))
    ranks = nodes.reduce_at_owners(distinct, np.ones(distinct.size, dtype=np.int64))
    shared = np.zeros(nodes.size, dtype=bool)
    shared[nodes.to_local(distinct)] = nodes.values_at(ranks, distinct) > 1
    return shared


Table = TypeVar("Table", CellForces, FacetMoments)


def _to_owners(nodes: NodeMap, table: Table) -> tuple[Table, Numbers]:
    """Send rows to the owners of their nodes; return what arrives and the senders. Collective."""
    sender = np.full(table.node.size, nodes.comm.rank)
    owners, columns = nodes.owners(table.node), vars(table).values()
    *arrived, senders = send_rows(nodes.comm, owners, *columns, sender)
    return type(table)(*arrived), senders


def _positions(node: Numbers, cell: Numbers, nodes: Numbers, cells: Numbers) -> Numbers:
    """Return the positions of pairs among some that ascend, by node and then cell."""
    limit = int(max(cell.max(initial=0), cells.max(initial=0))) + 1
    return np.searchsorted(node * limit + cell, nodes * limit + cells)
