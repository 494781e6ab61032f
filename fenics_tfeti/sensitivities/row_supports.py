"""Which rows of contacts and ties depend on which nodes of the mesh.

A derivative of every row by every node takes as many differences as there are groups of nodes of
which no row depends on two: the nodes of a group are moved together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

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

# normals at the corners of the facets around a row's nodes are means over the facets around these
_RINGS = 2
# difference between the derivatives of rows along a direction that is rounding, relative to the sum
# of their magnitudes; a row that depends on more nodes differs by more
_SAME_SLOPE = 1e-6


@dataclass(frozen=True)
class RowSupports:
    """The nodes on the boundary of the mesh that rows depend on."""

    nodes: NodeMap  # of vectors at the mesh's nodes
    numbers: Numbers  # (n,): global numbers of the nodes on the boundary, the same on all ranks
    size: Vector  # (n,): shortest edge there [m]
    near: sp.csr_matrix  # (n, n): nodes of common cells
    all_rows: sp.csr_matrix  # (rows, n): nodes of each row, of all ranks one after the other
    own: slice  # this rank's rows

    @staticmethod
    def of(found: ContactSet, space: FunctionSpace) -> RowSupports:
        """Return the supports of rows of contacts and then of ties. Collective.

        The space is that of vectors at the mesh's nodes. What the boundary's cells are is gathered
        on all ranks.
        """
        nodes, domain = NodeMap(space), space.mesh
        cells = _compat.cell_dofs(space)[: owned_cells(domain)]
        on_boundary = _on_boundary(space)
        cell, corner = np.nonzero(on_boundary[cells])
        first_cell, _ = first_of_rank(nodes.comm, len(cells))
        of_cells = _gathered(nodes, cell + first_cell, cells[cell, corner])
        row, of_rows, count = _row_nodes(found, nodes, on_boundary)
        first_row, total = first_of_rank(nodes.comm, count)
        rows = concatenate_ranks(nodes.comm, np.stack([row + first_row, of_rows], axis=1))
        numbers = np.unique(np.concatenate([of_cells[:, 1], rows[:, 1]]))
        incidence, all_rows = (
            _incidence(pairs[:, 0], np.searchsorted(numbers, pairs[:, 1]), size)
            for pairs, size in (
                (of_cells, (of_cells[:, 0].max(initial=-1) + 1, numbers.size)),
                (rows, (total, numbers.size)),
            )
        )
        size = np.zeros(numbers.size)
        is_own = (numbers >= nodes.first) & (numbers < nodes.first + nodes.owned)
        shortest = nodes.reduced_over_cells(_shortest_edges(space), np.minimum)
        size[is_own] = shortest[numbers[is_own] - nodes.first]
        size = nodes.comm.allreduce(size)
        near = incidence.T @ incidence
        own = slice(first_row, first_row + count)
        return RowSupports(nodes, numbers, size, near, all_rows, own)

    def widened(self, rings: int) -> RowSupports:
        """Return the supports with nodes of some more rings of cells."""
        rows = self.all_rows
        for _ in range(rings):
            rows = rows @ self.near
            rows.data[:] = 1
        return RowSupports(self.nodes, self.numbers, self.size, self.near, rows, self.own)

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

    def moved(self, moves: Vector) -> Function:
        """Return the displacement of the mesh's nodes for those (n, gdim) of its boundary [m]."""
        function = Function(self.nodes.space)
        position = positions(self.numbers, self.nodes.to_global(np.arange(self.nodes.size)))
        values = function.x.array.reshape(-1, self.nodes.components)
        values[position >= 0] = moves[position[position >= 0]]
        return function


def derivative_by_places(
    found: ContactSet,
    space: FunctionSpace,
    rows_at: Callable[[Function], Vector],
    step: float,
) -> Vector:
    """Return the derivative (owned, gdim) of the sum of numbers of rows by places. Collective.

    `rows_at` returns numbers of this rank's rows (rows,), of contacts and then of ties, on nodes
    after a displacement; the step is relative to the shortest edge at a node. Rows depend on more
    nodes as long as the derivatives along a direction without a pattern differ.
    """
    supports, rings = RowSupports.of(found, space), _RINGS
    comm, shape = supports.nodes.comm, (supports.numbers.size, supports.nodes.components)
    steps = step * supports.size[:, None]
    units = np.random.default_rng(1).uniform(-1.0, 1.0, shape)
    slope = comm.allreduce(_differences(supports, rows_at, steps * units).sum())
    while True:
        wide = supports.widened(rings)
        slopes = _by_groups(wide, rows_at, steps)
        terms = slopes * units
        error, size = abs(terms.sum() - slope), np.abs(terms).sum()
        if error <= _SAME_SLOPE * size:
            break
        if wide.all_rows.nnz == supports.widened(rings + 1).all_rows.nnz:
            warn_on_first_rank(
                comm,
                "derivatives by the places of nodes do not add up to that along a direction: they "
                f"differ by {error / size:.1e} of their magnitudes. Of nodes on the borders of "
                "both surfaces of a contact, J has derivatives of one side only; of others, a "
                "larger step may help",
            )
            break
        rings *= 2
    total = np.zeros((supports.nodes.owned, shape[1]))
    own = supports.numbers - supports.nodes.first
    here = (own >= 0) & (own < supports.nodes.owned)
    total[own[here]] = (slopes / steps)[here]
    return total


def _by_groups(
    supports: RowSupports, rows_at: Callable[[Function], Vector], steps: Vector
) -> Vector:
    """Return what the rows' numbers change by with steps (n, 1) of each node, (n, gdim)."""
    groups, gdim = supports.groups, supports.nodes.components
    slopes = np.zeros((groups.size, gdim))
    own = supports.all_rows[supports.own].tocoo()
    for group in range(groups.max(initial=-1) + 1):
        of_group = groups[own.col] == group
        rows, nodes = own.row[of_group], own.col[of_group]
        for axis in range(gdim):
            moves = np.zeros((groups.size, gdim))
            moves[groups == group, axis] = steps[groups == group, 0]
            np.add.at(slopes[:, axis], nodes, _differences(supports, rows_at, moves)[rows])
    return np.asarray(supports.nodes.comm.allreduce(slopes))


def _differences(
    supports: RowSupports, rows_at: Callable[[Function], Vector], moves: Vector
) -> Vector:
    """Return central differences (rows,) along displacements (n, gdim) of the boundary's nodes."""
    up, down = (rows_at(supports.moved(sign * moves)) for sign in (1.0, -1.0))
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
) -> tuple[Numbers, Numbers, int]:
    """Return rows and global nodes of the mesh of the terms of this rank's rows; how many rows."""
    of_space = found.boundary.nodes
    terms = [(p.terms.row, p.terms.nodes, p.terms.slaves.size) for p in found.all_conditions]
    terms += [
        (t.conditions.rows.row, t.conditions.rows.nodes, t.conditions.rows.size) for t in found.ties
    ]
    none = np.zeros(0, dtype=np.int64)
    rows, numbers, first = [none], [none], 0
    for row, number, count in terms:
        in_mesh = number < of_space.total
        rows.append(row[in_mesh] + first)
        numbers.append(number[in_mesh])
        first += count
    table = nodes.to_global(_node_of_mesh(of_space.space, nodes.space, on_boundary))
    return np.concatenate(rows), of_space.values_at(table, np.concatenate(numbers)), first


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
