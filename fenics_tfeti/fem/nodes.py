"""The nodes of a Lagrange space: local and global numbers, owners, and numbers of the input."""

from __future__ import annotations

from functools import cached_property
from typing import Any, cast

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function, FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.parallel import all_to_all, first_of_rank, send_rows
from fenics_tfeti.typing import Array, Indices, Numbers, Vector


class MeshComm(MPI.Intracomm):
    """The ranks of a mesh, which it keeps alive: dolfinx frees the communicator with the mesh."""

    mesh: Mesh

    def __new__(cls, mesh: Mesh) -> MeshComm:
        """Return the communicator of a mesh."""
        comm = cast("MeshComm", super().__new__(cls, mesh.comm))
        comm.mesh = mesh
        return comm


class NodeMap:
    """The nodes of a space on this rank, local numbers first of those that it owns, then ghosts.

    Each rank owns consecutive global numbers. Arrays of nodes have one row for each.
    """

    # of `ContactNodes` the local numbers (size,) of the nodes they are copies of, and the contacts
    originals: Numbers | slice = slice(None)
    contact: Numbers | None = None

    def __init__(self, space: FunctionSpace) -> None:
        self.space = space
        self.comm: MPI.Intracomm = MeshComm(space.mesh)
        self.components: int = space.dofmap.index_map_bs
        self._map = space.dofmap.index_map
        self.first, end = self._map.local_range  # global numbers of the owned nodes
        self.owned: int = end - self.first  # number of nodes that this rank owns
        self.size: int = self.owned + self._map.num_ghosts
        self.total: int = self._map.size_global

    @property
    def coordinates(self) -> Vector:
        """The places (owned, gdim) of the owned nodes now [m]."""
        x = self.space.tabulate_dof_coordinates()
        return x[: self.owned, : self.space.mesh.geometry.dim]

    def values(self, uh: Function) -> Vector:
        """Return the values (size, components) of a function of the space."""
        return self.copied(uh.x.array.reshape(-1, self.components))

    def copied(self, values: Array) -> Array:
        """Return values (n, ...) at this rank's nodes of the space, for each copy of them."""
        return values[self.originals]

    def to_global(self, local: Array) -> Numbers:
        """Return the global numbers of local nodes, in an array of the same shape."""
        number: Numbers = local.astype(np.int64)
        if not self._ghosts.size:
            return number + self.first
        is_ghost = number >= self.owned
        number[is_ghost] = self._ghosts[number[is_ghost] - self.owned]
        number[~is_ghost] += self.first
        return number

    def to_local(self, nodes: Numbers) -> Numbers:
        """Return the local numbers of global nodes (k,) on this rank."""
        local: Numbers = nodes - self.first
        if not self._ghosts.size:
            return local
        is_ghost = (local < 0) | (local >= self.owned)
        order = self._order_of_ghosts
        position = np.searchsorted(self._ghosts, nodes[is_ghost], sorter=order)
        local[is_ghost] = self.owned + order[position]
        return local

    @cached_property
    def _order_of_ghosts(self) -> Numbers:
        return np.argsort(self._ghosts)

    @cached_property
    def _ghosts(self) -> Numbers:
        """The global numbers of the ghosts."""
        return np.asarray(self._map.ghosts, dtype=np.int64)

    @cached_property
    def _ends(self) -> Numbers:
        """The end of the numbers that each rank owns. The first time collective."""
        return np.array(self.comm.allgather(self.first + self.owned), dtype=np.int64)

    def owners(self, nodes: Numbers) -> Numbers:
        """Return the ranks that own global nodes, in any shape. The first time collective."""
        return np.searchsorted(self._ends, nodes, side="right")

    def values_at(self, values: Array, nodes: Numbers) -> Array:
        """Fetch values at nodes from the ranks that own them, in the shape of `nodes`. Collective.

        This rank's values (owned, ...) are of the nodes that it owns; more rows do not matter.
        """
        if self.comm.size == 1:
            return values[nodes]
        distinct, inverse = np.unique(nodes, return_inverse=True)
        queries = np.split(distinct, np.searchsorted(distinct, self._ends[:-1]))
        rows = [values[query - self.first] for query in all_to_all(self.comm, queries)]
        return np.concatenate(all_to_all(self.comm, rows))[inverse.reshape(nodes.shape)]

    def to_owners(self, nodes: Numbers, *data: Array) -> tuple[Array, ...]:
        """Send rows (node, data...) to the owners; return local nodes and data, by sender."""
        arrived, *rest = send_rows(self.comm, self.owners(nodes), nodes, *data)
        return arrived - self.first, *rest

    def reduce_at_owners(self, nodes: Numbers, values: Array, ufunc: Any = np.add) -> Array:
        """Reduce rows of values (k, ...) by their nodes, of any ranks. Collective.

        The result is (owned, ...): sums or, by another ufunc, maxima and the like; zero at nodes
        without values.
        """
        local, values = self.to_owners(nodes, values)
        order = np.argsort(local, kind="stable")
        local, values = local[order], values[order]
        first = np.flatnonzero(np.diff(local, prepend=-1))
        result = np.zeros((self.owned, *values.shape[1:]), dtype=values.dtype)
        if first.size:
            result[local[first]] = ufunc.reduceat(values, first, axis=0)
        return result

    def reduced_over_cells(self, values: Array, ufunc: Any) -> Array:
        """Return values (owned,) reduced from those of cells (m,) around each node. Collective."""
        nodes = _compat.cell_dofs(self.space)[: values.size]
        at_nodes = np.repeat(values, nodes.shape[1])
        return self.reduce_at_owners(self.to_global(nodes).ravel(), at_nodes, ufunc)

    @cached_property
    def input_numbers(self) -> Numbers:
        """Numbers (owned,) of the owned nodes by the mesh's input. The first time collective.

        The number of a node is its place in the first cell that it belongs to, in the order in
        which the cells were given to dolfinx; of a submesh, which has no input, in the global one.
        It is the same for the same input on any ranks. Numbers are distinct, with gaps.
        """
        cells = _compat.input_cells(self.space.mesh)
        nodes = _compat.cell_dofs(self.space)[: cells.size].astype(np.int64)
        number = cells[:, np.newaxis] * nodes.shape[1] + np.arange(nodes.shape[1])
        lowest = np.full(self.size, -1, dtype=np.int64)
        order = np.argsort(cells)[::-1]
        # of several values for one position the last one stays
        lowest[nodes[order]] = number[order]
        local = np.flatnonzero(lowest >= 0)
        return self.reduce_at_owners(self.to_global(local), lowest[local], np.minimum)


class ContactNodes(NodeMap):
    """The nodes of several contacts, with numbers of their own: each node once in each contact.

    Numbers of a rank ascend with the contact and then with the node. Each copy belongs to the rank
    that owns the node.
    """

    originals: Numbers
    contact: Numbers

    def __init__(self, nodes: NodeMap, local: Indices, contact: Numbers) -> None:
        """Find the nodes of facets (f, t), with local numbers, of contacts (f,). Collective."""
        self.space, self.components, self.comm = nodes.space, nodes.components, nodes.comm
        self._size = nodes.size
        number = nodes.to_global(local)
        keys, inverse = np.unique(contact[:, None] * nodes.total + number, return_inverse=True)
        original = np.zeros(keys.size, dtype=np.int64)
        original[inverse.ravel()] = local.ravel()
        owner = nodes.owners(keys % nodes.total)
        order = np.argsort(owner, kind="stable")
        cuts = np.searchsorted(owner[order], np.arange(1, self.comm.size))
        queries = all_to_all(self.comm, np.split(keys[order], cuts))
        own_keys = np.unique(np.concatenate(queries))
        self.owned = own_keys.size
        self.first, self.total = first_of_rank(self.comm, self.owned)
        answers = [self.first + np.searchsorted(own_keys, query) for query in queries]
        numbers = np.zeros(keys.size, dtype=np.int64)
        numbers[order] = np.concatenate(all_to_all(self.comm, answers))
        is_ghost = owner != self.comm.rank
        self._ghosts, ghost_order = np.unique(numbers[is_ghost], return_index=True)
        self.size = self.owned + self._ghosts.size
        self.facet_nodes = self.to_local(numbers)[inverse.reshape(local.shape)]  # (f, t)
        of_ghosts = np.flatnonzero(is_ghost)[ghost_order]
        own = own_keys % nodes.total - nodes.first
        self.originals = np.concatenate([own, original[of_ghosts]])
        self.contact = np.concatenate([own_keys, keys[of_ghosts]]) // nodes.total

    def copies(self, contact: Numbers, original: Numbers) -> Numbers:
        """Return the numbers of owned nodes (k,) in contacts (k,), by their local numbers."""
        keys = self.contact[: self.owned] * self._size + self.originals[: self.owned]
        return self.first + np.searchsorted(keys, contact * self._size + original)
