"""Which rows of contacts and ties depend on which nodes of the mesh.

A derivative of every row by every node takes as many differences as there are groups of nodes of
which no row depends on two: the nodes of a group are moved together. Nodes are those of the mesh,
whose places change, or those of a displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp

from dolfinx.fem import Function, FunctionSpace, locate_dofs_topological
from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.contact_set import ContactSet
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import cell_vertices, exterior_facets, owned_cells, vertex_nodes
from fenics_tfeti.parallel import (
    concatenate_ranks,
    first_of_rank,
    largest_of_ranks,
    positions,
    warn_on_first_rank,
)
from fenics_tfeti.typing import Array, Mask, Numbers, Vector

# moves of the nodes -> numbers of this rank's rows
NumbersAt: TypeAlias = Callable[[Function], sp.csr_matrix]

# normals at the corners of the facets around a row's nodes are means over the facets around these
_RINGS = 2
# difference between the derivatives of rows along a direction that is rounding, relative to the sum
# of their magnitudes; a row that depends on more nodes differs by more
_SAME_SLOPE = 1e-6


@dataclass(frozen=True)
class RowSupports:
    """The nodes on the boundary of the mesh that rows depend on."""

    nodes: NodeMap  # of vectors at nodes of the mesh, or of displacements
    numbers: Numbers  # (n,): global numbers of the nodes on the boundary, the same on all ranks
    size: Vector  # (n,): shortest edge there [m]
    near: sp.csr_matrix  # (n, n): nodes of common cells
    all_rows: sp.csr_matrix  # (rows, n): nodes of each row, of all ranks one after the other
    masters: sp.csr_matrix  # (rows, n): those of masters of mortar conditions, not in `all_rows`
    own: slice  # this rank's rows

    @staticmethod
    def of(found: ContactSet, space: FunctionSpace, counts: Mask | None = None) -> RowSupports:
        """Return the supports of rows of contacts and then of ties. Collective.

        The space is that of vectors at the mesh's nodes, or of displacements. What the boundary's
        cells are is gathered on all ranks. Of rows that do not count (rows,) nothing is known.
        """
        nodes, domain = NodeMap(space), space.mesh
        cells = _compat.cell_dofs(space)[: owned_cells(domain)]
        on_boundary = _on_boundary(space)
        cell, corner = np.nonzero(on_boundary[cells])
        first_cell, _ = first_of_rank(nodes.comm, len(cells))
        of_cells = _gathered(nodes, cell + first_cell, cells[cell, corner])
        row, of_rows, is_master, count = _row_nodes(found, nodes, on_boundary)
        if counts is not None:
            row, of_rows, is_master = (x[counts[row]] for x in (row, of_rows, is_master))
        first_row, total = first_of_rank(nodes.comm, count)
        columns = [row + first_row, of_rows, is_master]
        rows = concatenate_ranks(nodes.comm, np.stack(columns, axis=1))
        numbers = np.unique(np.concatenate([of_cells[:, 1], rows[:, 1]]))
        incidence, all_rows, masters = (
            _incidence(pairs[:, 0], np.searchsorted(numbers, pairs[:, 1]), (size, numbers.size))
            for pairs, size in (
                (of_cells, of_cells[:, 0].max(initial=-1) + 1),
                (rows[rows[:, 2] == 0], total),
                (rows[rows[:, 2] == 1], total),
            )
        )
        size = np.zeros(numbers.size)
        shortest = nodes.reduced_over_cells(_shortest_edges(space), np.minimum)
        near = incidence.T @ incidence
        own = slice(first_row, first_row + count)
        supports = RowSupports(nodes, numbers, size, near, all_rows, masters, own)
        size[supports.here] = shortest[supports.owned]
        return replace(supports, size=nodes.comm.allreduce(size))

    def widened(self, rings: int) -> RowSupports:
        """Return the supports with nodes of some more rings of cells, at first not of masters."""
        rows = self._widened(self.all_rows, rings)
        return replace(self, all_rows=rows + self._widened(self.masters, rings - _RINGS))

    def _widened(self, rows: sp.csr_matrix, rings: int) -> sp.csr_matrix:
        for _ in range(rings):
            rows = rows @ self.near
            rows.data[:] = 1
        return rows

    @cached_property
    def groups(self) -> Numbers:
        """The group (n,) of each node: no row depends on two nodes of one; -1 for nodes of none."""
        together = (self.all_rows.T @ self.all_rows).tocsr()
        group = np.full(self.numbers.size, -1)
        for node in range(self.numbers.size):
            others = together.indices[together.indptr[node] : together.indptr[node + 1]]
            if others.size:
                taken = np.zeros(others.size + 2, dtype=bool)
                taken[np.minimum(group[others], others.size)] = True
                group[node] = np.argmin(taken[:-1])
        return group

    @cached_property
    def here(self) -> Mask:
        """Which of the nodes this rank owns, (n,)."""
        own = self.numbers - self.nodes.first
        return (own >= 0) & (own < self.nodes.owned)

    @cached_property
    def owned(self) -> Numbers:
        """The local numbers of the nodes that this rank owns."""
        return self.numbers[self.here] - self.nodes.first

    def moved(self, moves: Vector) -> Function:
        """Return the displacement of the mesh's nodes for those (n, gdim) of its boundary [m]."""
        function = Function(self.nodes.space)
        position = positions(self.numbers, self.nodes.to_global(np.arange(self.nodes.size)))
        values = function.x.array.reshape(-1, self.nodes.components)
        values[position >= 0] = moves[position[position >= 0]]
        return function


@dataclass(frozen=True)
class RowDerivatives:
    """Derivatives of numbers of this rank's rows by moves of nodes, one by one."""

    row: Numbers  # (e,)
    column: Numbers  # (e,): which of the row's numbers
    unknown: Numbers  # (e,): gdim * position of the node in `RowSupports.numbers` + component
    value: Vector  # (e,)

    @staticmethod
    def of(supports: RowSupports, numbers_at: NumbersAt, step: float, what: str) -> RowDerivatives:
        """Return them by central differences. Collective.

        `numbers_at` returns numbers of this rank's rows (rows, columns), all in the same unit, of
        contacts and then of ties, after moves of the nodes; the step is relative to the shortest
        edge at a node. Rows depend on more nodes as long as the derivatives along a direction
        without a pattern differ.

        Warns
        -----
        UserWarning
            Derivatives of `what` disagree with that along a direction.
        """
        rings, comm = _RINGS, supports.nodes.comm
        shape = supports.numbers.size, supports.nodes.components
        steps = step * supports.size[:, None]
        units = np.random.default_rng(1).uniform(-1.0, 1.0, shape)
        along = _differences(supports, numbers_at, steps * units)
        while True:
            wide = supports.widened(rings)
            found = _by_groups(wide, numbers_at, steps)
            terms = found.value * (steps * units).ravel()[found.unknown]
            of_terms = sp.coo_matrix((terms, (found.row, found.column)), along.shape)
            sums = abs(along - of_terms.tocsr()).sum(), np.abs(terms).sum()
            error, size = comm.allreduce(np.array(sums)).tolist()
            if error <= _SAME_SLOPE * size:
                return found
            if wide.all_rows.nnz == supports.widened(rings + 1).all_rows.nnz:
                warn_on_first_rank(
                    comm,
                    f"derivatives of {what} do not add up to that along a direction: they differ "
                    f"by {error / size:.1e} of their magnitudes. Of nodes on the borders of both "
                    "surfaces of a contact, J has derivatives of one side only; of others, a "
                    "larger step may help",
                )
                return found
            rings *= 2


def derivative_by_places(
    found: ContactSet, space: FunctionSpace, numbers_at: NumbersAt, step: float
) -> Vector:
    """Return the derivative (owned, gdim) of the sum of numbers of rows by places. Collective.

    The numbers (rows, 1), of contacts and then of ties, are those on nodes after a displacement.
    """
    supports = RowSupports.of(found, space)
    nodes = supports.nodes
    derivatives = RowDerivatives.of(supports, numbers_at, step, "J by the places of nodes")
    size = supports.numbers.size * nodes.components
    sums = np.bincount(derivatives.unknown, derivatives.value, size)
    slopes = nodes.comm.allreduce(sums).reshape(-1, nodes.components)
    total = np.zeros((nodes.owned, nodes.components))
    total[supports.owned] = slopes[supports.here]
    return total


def _by_groups(supports: RowSupports, numbers_at: NumbersAt, steps: Vector) -> RowDerivatives:
    """Return derivatives by differences with steps (n, 1) of each node. Collective."""
    groups, gdim = supports.groups, supports.nodes.components
    own, parts = supports.all_rows[supports.own].tocoo(), []
    for group in range(groups.max(initial=-1) + 1):
        of_group = groups[own.col] == group
        node = np.full(supports.own.stop - supports.own.start, -1)
        node[own.row[of_group]] = own.col[of_group]
        for axis in range(gdim):
            moves = np.zeros((groups.size, gdim))
            moves[groups == group, axis] = steps[groups == group, 0]
            change = _differences(supports, numbers_at, moves).tocoo()
            depends = node[change.row] >= 0
            row, at = change.row[depends], node[change.row[depends]]
            value = change.data[depends] / steps[at, 0]
            parts.append((row, change.col[depends], gdim * at + axis, value))
    none = np.zeros(0, dtype=np.int64)
    parts.append((none, none, none, np.zeros(0)))
    return RowDerivatives(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _differences(supports: RowSupports, numbers_at: NumbersAt, moves: Vector) -> sp.csr_matrix:
    """Return central differences (rows, columns) along moves (n, gdim) of the boundary's nodes."""
    up, down = (numbers_at(supports.moved(sign * moves)) for sign in (1.0, -1.0))
    return 0.5 * (up - down)


def _incidence(rows: Numbers, columns: Numbers, shape: tuple[int, int]) -> sp.csr_matrix:
    """Return a matrix of ones, with each pair once."""
    matrix = sp.csr_matrix((np.ones(rows.size, dtype=np.int64), (rows, columns)), shape)
    matrix.data[:] = 1
    return matrix


def _gathered(nodes: NodeMap, labels: Numbers, local: Array) -> Numbers:
    """Return pairs (label, global node) of all ranks."""
    pairs = np.stack([labels, nodes.to_global(local)], axis=1)
    return concatenate_ranks(nodes.comm, pairs)


def _on_boundary(space: FunctionSpace) -> Mask:
    """Tell which of this rank's nodes are on the boundary. Collective."""
    domain, nodes = space.mesh, NodeMap(space)
    facets = np.flatnonzero(exterior_facets(domain)).astype(np.int32)
    mask = np.zeros(nodes.size, dtype=bool)
    mask[locate_dofs_topological(space, domain.topology.dim - 1, facets)] = True
    return mask


def _row_nodes(
    found: ContactSet, nodes: NodeMap, on_boundary: Mask
) -> tuple[Numbers, Numbers, Mask, int]:
    """Return rows and global nodes of the mesh of the terms of this rank's rows; how many rows.

    With them is whether the node is on the master of a mortar condition, all of whose nodes are in
    terms; a gap between nodes depends on the facets around the partner, too.
    """
    of_space, first = found.boundary.nodes, 0
    none = np.zeros(0, dtype=np.int64)
    parts = [(none, none, none > 0)]
    terms = [
        (p.terms.row, p.terms.nodes, p.is_mortar & ~p.terms.on_slave, p.terms.slaves.size)
        for p in found.all_conditions
    ]
    ties = [t.conditions.rows for t in found.ties]
    terms += [(t.row, t.nodes, np.zeros(t.nodes.size, dtype=bool), t.size) for t in ties]
    for row, number, is_master, count in terms:
        in_mesh = number < of_space.total
        parts.append((row[in_mesh] + first, number[in_mesh], is_master[in_mesh]))
        first += count
    rows, numbers, is_master = (np.concatenate(part) for part in zip(*parts, strict=True))
    table = nodes.to_global(_node_of_mesh(of_space.space, nodes.space, on_boundary))
    return rows, of_space.values_at(table, numbers), is_master, first


def _node_of_mesh(space: FunctionSpace, places: FunctionSpace, on_boundary: Mask) -> Numbers:
    """Return the local node of the mesh at each node of a space, or a near one on the boundary."""
    cells, others = _compat.cell_dofs(space), _compat.cell_dofs(places)
    table = np.zeros(NodeMap(space).size, dtype=np.int64)
    some = np.argmax(on_boundary[others], axis=1)
    near = np.take_along_axis(others, some[:, None], axis=1)
    is_near = on_boundary[near[:, 0]]
    table[cells[is_near]] = np.broadcast_to(near[is_near], cells[is_near].shape)
    if cells.shape == others.shape:
        table[cells] = others
    else:
        table[vertex_nodes(space)] = vertex_nodes(places)
    return table


def _shortest_edges(space: FunctionSpace) -> Vector:
    """Return the shortest distance of two vertices of each cell that this rank owns [m]."""
    edges = _edges(space.mesh, space.mesh.geometry.x)
    return edges[: owned_cells(space.mesh)].min(axis=1, initial=np.inf)


def largest_distortion(domain: Mesh, moves: Vector) -> float:
    """Return the largest relative change of an edge of cells by moves (nodes, 3). Collective."""
    change, length = (_edges(domain, values) for values in (moves, domain.geometry.x))
    return largest_of_ranks(domain.comm, change / length)


def _edges(domain: Mesh, values: Vector) -> Vector:
    """Return distances (cells, pairs) of values (nodes, 3) at all pairs of vertices of a cell."""
    at_vertices = values[cell_vertices(domain)]
    first, second = np.triu_indices(at_vertices.shape[1], 1)
    edges: Vector = np.linalg.norm(at_vertices[:, first] - at_vertices[:, second], axis=2)
    return edges
