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

from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.mesh_error.faces import add_rows
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import connected_labels
from fenics_tfeti.parallel import send_rows
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# numbers in the matrices that are solved with at once
_ENTRIES = 2**20


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
    problem = _NodeProblems(forces, moments)
    return problem.moments(), forces.node, problem.imbalance


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


class _NodeProblems:
    """The problems of some nodes, all of whose cells are there."""

    def __init__(self, forces: CellForces, moments: FacetMoments) -> None:
        order = np.lexsort((forces.cell, forces.node))
        self._order, node, cell = order, forces.node[order], forces.cell[order]
        self._first = np.flatnonzero(np.diff(node, prepend=-1))  # row of each node's first cell
        self._count = np.diff(np.append(self._first, node.size))
        self._number = np.repeat(np.arange(self._first.size), self._count)  # node of each row
        self._place = np.arange(node.size) - self._first[self._number]
        position = _positions(node, cell, moments.node, moments.cell)
        self._join(position, moments)
        self._b = -forces.force[order]
        self._subtract_start()
        self._labels = [self._components(c) for c in range(self._free.shape[1])]
        self.imbalance = np.zeros(self._b.shape[:2])
        for c, (label, is_closed) in enumerate(self._labels):
            self._ground(c, label, is_closed)
        self.imbalance = self.imbalance[np.argsort(order)]

    def _join(self, position: Numbers, moments: FacetMoments) -> None:
        """Find both sides of each moment: rows of forces, the second of none is -1."""
        by_facet = np.lexsort((moments.facet, moments.node))
        keys = np.stack([moments.node[by_facet], moments.facet[by_facet]])
        is_first = np.ones(by_facet.size, dtype=bool)
        is_first[1:] = (keys[:, 1:] != keys[:, :-1]).any(axis=0)
        column = np.cumsum(is_first) - 1
        count = int(column[-1]) + 1 if column.size else 0
        self._column = np.empty(by_facet.size, dtype=np.int64)
        self._column[by_facet] = column
        self._sign = np.empty(by_facet.size)
        self._sign[by_facet] = np.where(is_first, 1.0, -1.0)
        self._sides = np.full((count, 2), -1)
        self._sides[column, np.where(is_first, 0, 1)] = position[by_facet]
        self._free = moments.free[by_facet[is_first]]
        start = np.zeros((count, moments.moment.shape[1]))
        add_rows(start, self._column, self._sign[:, None] * moments.moment)
        sides = np.count_nonzero(self._sides >= 0, axis=1)
        self._start = start / sides[:, None] * self._free

    def _subtract_start(self) -> None:
        for side, sign in ((0, 1.0), (1, -1.0)):
            row = self._sides[:, side]
            there = row >= 0
            moment = np.repeat(self._start[there, :, None], self._b.shape[2], axis=2)
            add_rows(self._b, row[there], -sign * moment)

    def _components(self, c: int) -> tuple[Numbers, Mask]:
        """Return the connected component of each row, and which components nothing holds."""
        free, rows = self._free[:, c], self._number.size
        two = self._sides[:, 1] >= 0
        label = connected_labels(self._sides[free & two], rows)
        is_closed = np.ones(int(label.max(initial=-1)) + 1, dtype=bool)
        is_closed[label[self._sides[free & ~two, 0]]] = False
        return label, is_closed

    def _ground(self, c: int, label: Numbers, is_closed: Mask) -> None:
        """Subtract the mean from the forces of what nothing holds; keep the sum."""
        sizes = np.bincount(label)
        for v in range(self._b.shape[2]):
            total = np.where(is_closed, np.bincount(label, self._b[:, c, v], sizes.size), 0.0)
            self._b[:, c, v] -= (total / np.maximum(sizes, 1))[label]
            self.imbalance[:, c] = np.maximum(self.imbalance[:, c], np.abs(total)[label])

    def moments(self) -> Vector:
        """Solve, and return the moments (t, d, v) from the side of each cell."""
        y = np.zeros_like(self._b)
        # most nodes have the same matrix for all components
        is_equal = (self._free == self._free[:, :1]).all(axis=1)
        has_one = np.ones(self._first.size, dtype=bool)
        has_one[self._number[self._sides[~is_equal, 0]]] = False
        components = list(range(self._b.shape[1]))
        self._solve(has_one, components, y)
        for c in components:
            self._solve(~has_one, [c], y)
        difference = y[self._sides[:, 0]]
        two = self._sides[:, 1] >= 0
        difference[two] -= y[self._sides[two, 1]]
        m = self._start[:, :, None] + self._free[:, :, None] * difference
        return np.asarray(self._sign[:, None, None] * m[self._column])

    def _solve(self, mask: Mask, components: list[int], y: Vector) -> None:
        """Solve for some components at some nodes, those with equally many cells at once."""
        c = components[0]
        label, is_closed = self._labels[c]
        grounded = np.zeros(label.size, dtype=bool)
        _, lowest = np.unique(label, return_index=True)
        grounded[lowest] = is_closed
        active = self._free[:, c]
        of_column = self._number[self._sides[:, 0]]
        # columns of a node one after the other
        by_node = np.argsort(of_column, kind="stable")
        ends = np.searchsorted(of_column[by_node], np.arange(self._first.size + 1))
        for n in np.unique(self._count[mask]):
            members = np.flatnonzero(mask & (self._count == n))
            for batch in batches(members.size, max(1, _ENTRIES // int(n) ** 2)):
                chosen = members[batch]
                lengths = ends[chosen + 1] - ends[chosen]
                slot = np.repeat(np.arange(chosen.size), lengths)
                offset = np.arange(slot.size) - np.repeat(np.cumsum(lengths) - lengths, lengths)
                columns = by_node[np.repeat(ends[chosen], lengths) + offset]
                kept = active[columns]
                A = self._matrices(slot[kept], columns[kept], chosen.size, int(n))
                rows = self._first[chosen][:, None] + np.arange(n)
                A[:, np.arange(n), np.arange(n)] += grounded[rows]
                b = self._b[rows][:, :, components]
                solved = np.linalg.solve(A, b.reshape(*b.shape[:2], -1)).reshape(b.shape)
                y[rows[:, :, None], np.array(components)] = solved

    def _matrices(self, slot: Numbers, columns: Numbers, count: int, n: int) -> Vector:
        """Return the graph Laplacians (count, n, n) of moments in columns."""
        A = np.zeros(count * n * n)
        sides = self._sides[columns]
        places = np.where(sides >= 0, self._place[sides], -1)
        for i, j, sign in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, -1.0), (1, 0, -1.0)):
            both = (places[:, i] >= 0) & (places[:, j] >= 0)
            flat = (slot[both] * n + places[both, i]) * n + places[both, j]
            A += sign * np.bincount(flat, minlength=A.size)
        return A.reshape(count, n, n)


def _positions(node: Numbers, cell: Numbers, nodes: Numbers, cells: Numbers) -> Numbers:
    """Return the positions of pairs among some that ascend, by node and then cell."""
    limit = int(max(cell.max(initial=0), cells.max(initial=0))) + 1
    return np.searchsorted(node * limit + cell, nodes * limit + cells)
