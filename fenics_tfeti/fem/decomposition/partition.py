"""Each rank's cells into connected subdomains (sec. 11.4). No cell moves to another rank."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.decomposition.cell_graph import components, connected_groups, groups
from fenics_tfeti.fem.decomposition.grid import Grid, block_of_cells, find_grid
from fenics_tfeti.fem.decomposition.parts import number_parts
from fenics_tfeti.fem.topology import cell_vertices, owned_cells
from fenics_tfeti.parallel import raise_collectively

__all__ = ["Partitioner", "given_subdomains", "split_into_subdomains"]

logger = logging.getLogger(__name__)

Indices = NDArray[np.int32]
Partitioner = Literal["auto", "scotch"]


def split_into_subdomains(
    space: FunctionSpace, bodies: Bodies, unknowns: int, partitioner: Partitioner = "auto"
) -> list[Indices]:
    """Split this rank's cells, body by body, into connected subdomains.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space, to count unknowns.
    bodies : Bodies
        The bodies.
    unknowns : int
        Wanted number of unknowns of a subdomain.
    partitioner : {"auto", "scotch"}
        "scotch" partitions the graph of the cells. "auto" does so as well, except where the nodes
        of this rank's cells of a body form a grid along the axes: then they are cut into blocks.

    Returns
    -------
    list of integer arrays
        The cells of each subdomain. Bodies that are images of each other are cut equally.
    """
    block = space.dofmap.index_map_bs
    subdomains: list[Indices] = []
    bodies_of_rank = groups(components(bodies.graph, bodies.of_cell)[1])
    cuts: dict[bytes, NDArray[np.int64]] = {}
    for body in number_parts(space, bodies_of_rank, range(len(bodies_of_rank))):
        cells = body.cells
        parts = round(block * body.nodes.size / unknowns)
        if parts <= 1:
            subdomains.append(cells)
            continue
        graph = bodies.graph[cells][:, cells]
        label = cuts.get(body.shape) if body.shape is not None else None
        if label is None:
            grid = _find_grid(space.mesh, cells) if partitioner == "auto" else None
            label = (
                block_of_cells(grid, unknowns / block)
                if grid is not None
                else _compat.partition_graph(graph.indptr, graph.indices, min(parts, cells.size))
            ).astype(np.int64)
            if body.shape is not None:
                cuts[body.shape] = label
        subdomains += connected_groups(graph, label, cells)
    return subdomains


def given_subdomains(domain: Mesh, bodies: Bodies, labels: Sequence[int]) -> list[Indices]:
    """Make subdomains by the user's labels: cells of one label on one rank and in one body.

    Parameters
    ----------
    domain : Mesh
        The mesh.
    bodies : Bodies
        The bodies.
    labels : (cells,) sequence of int
        Label of each cell that this rank owns.

    Returns
    -------
    list of integer arrays
        The cells of each subdomain; a label whose cells are not connected gives several.

    Raises
    ------
    InputError
        If there is not one label for each cell.
    """
    label = np.asarray(labels)
    owned = owned_cells(domain)
    with raise_collectively(domain.comm):
        if label.shape != (owned,):
            raise InputError(
                f"'subdomains' has shape {label.shape}, but rank {domain.comm.rank} owns {owned} "
                "cells: give one label for each cell that the rank owns, without ghosts"
            )
    given, number = np.unique(label, return_inverse=True)
    both = bodies.of_cell * given.size + number
    subdomains = connected_groups(bodies.graph, both, np.arange(owned, dtype=np.int32))
    if len(subdomains) > np.unique(both).size:
        logger.info(
            "rank %d: %d subdomain labels gave %d connected subdomains",
            domain.comm.rank,
            given.size,
            len(subdomains),
        )
    return subdomains


def _find_grid(domain: Mesh, cells: Indices) -> Grid | None:
    rows, cell_nodes = np.unique(cell_vertices(domain)[cells], return_inverse=True)
    points = domain.geometry.x[rows, : domain.geometry.dim]
    return find_grid(points, cell_nodes.reshape(cells.size, -1))
