"""The nodes of a rank, with numbers that do not depend on how dolfinx distributes a mesh."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem import _compat
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Numbers


@dataclass(frozen=True)
class OwnedNodes:
    """The n nodes that this rank owns."""

    total: int  # the number of nodes over all ranks
    coordinates: NDArray[np.float64]  # (n, gdim) [m]
    numbers: Numbers  # see `input_numbers`; of a mesh without input their global numbers

    @staticmethod
    def from_space(space: FunctionSpace, numbers: Numbers | None) -> OwnedNodes:
        """Return the nodes of a space, where they are now, with their numbers."""
        index_map = space.dofmap.index_map
        first, end = index_map.local_range
        x = space.tabulate_dof_coordinates()[: end - first, : space.mesh.geometry.dim]
        numbers = np.arange(first, end) if numbers is None else numbers
        return OwnedNodes(index_map.size_global, x, numbers)


def input_numbers(space: FunctionSpace) -> Numbers | None:
    """Return numbers (n,) of this rank's nodes of a Lagrange space by the mesh's input. Collective.

    The number of a node is its place in the first cell that it belongs to, in the order in which
    the cells were given to dolfinx. It is the same for the same input on any ranks. Numbers are
    distinct, with gaps; a submesh has no input: None on all ranks.
    """
    comm, index_map = space.mesh.comm, space.dofmap.index_map
    cells = _compat.input_cells(space.mesh)
    if not comm.allreduce(cells is not None, MPI.LAND) or cells is None:
        return None
    nodes = _compat.cell_dofs(space)[: cells.size].astype(np.int64)
    number = cells[:, np.newaxis] * nodes.shape[1] + np.arange(nodes.shape[1])
    in_cells = np.zeros(index_map.size_local + index_map.num_ghosts, dtype=bool)
    in_cells[nodes] = True
    local = np.flatnonzero(in_cells)
    lowest = _lowest(nodes, number, in_cells.size)[local]
    keys = np.asarray(index_map.local_to_global(local.astype(np.int32)), dtype=np.int64)
    directory = Directory(comm, keys)
    arrived, lowest = directory.collect(keys, lowest)
    lowest_at_home = _lowest(
        directory.position(arrived)[:, np.newaxis], lowest[:, np.newaxis], directory.keys.size
    )
    numbers: Numbers = directory.lookup(np.arange(*index_map.local_range), lowest_at_home)[1]
    return numbers


def _lowest(positions: Numbers, numbers: Numbers, size: int) -> Numbers:
    """Return the lowest number at each of so many positions; rows (k, v) of numbers ascend."""
    order = np.argsort(numbers[:, 0])[::-1]
    lowest = np.zeros(size, dtype=np.int64)
    # of several values for one position the last one stays
    lowest[positions[order]] = numbers[order]
    return lowest
