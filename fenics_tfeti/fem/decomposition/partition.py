"""Each rank's cells into connected subdomains (sec. 11.4). No cell moves to another rank."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy.sparse as sp

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies, components, groups
from fenics_tfeti.fem.decomposition.grid import block_of_cells, cells_of_cube, find_grid
from fenics_tfeti.fem.decomposition.parts import number_parts
from fenics_tfeti.fem.decomposition.round_parts import cut_into_slabs, mean_aspect, rounded
from fenics_tfeti.fem.topology import cell_vertices, owned_cells
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Indices, Numbers, Vector

logger = logging.getLogger(__name__)

Partitioner = Literal["auto", "scotch", "slabs"]

# unknowns of a subdomain by default
SUBDOMAIN_SIZE = 3000
# mean aspect of slabs that are round enough: no others are tried
_ROUND = 1.2


def split_into_subdomains(
    space: FunctionSpace,
    bodies: Bodies,
    unknowns: int,
    partitioner: Partitioner = "auto",
    x: Vector | None = None,
) -> list[Indices]:
    """Split this rank's cells, body by body, into connected subdomains of about so many unknowns.

    "scotch" partitions the graph of the cells, "slabs" cuts across the longest axes. "auto" cuts
    into blocks where the nodes of this rank's cells of a body form a grid along the axes, else into
    slabs or into the parts of SCOTCH, as they are or rounded: whichever are roundest in the mean.
    Bodies that are images of each other are cut equally. Where they are known, `x` are the
    coordinates (dofs, 3) of the blocked degrees of freedom [m].
    """
    block = space.dofmap.index_map_bs
    subdomains: list[Indices] = []
    bodies_of_rank = groups(bodies.piece)
    cuts: dict[bytes, Numbers] = {}
    for body in number_parts(space, bodies_of_rank, range(len(bodies_of_rank)), x):
        cells = body.cells
        if round(block * body.nodes.size / unknowns) <= 1:
            subdomains.append(cells)
            continue
        graph = bodies.graph[cells][:, cells]
        label = cuts.get(body.shape) if body.shape is not None else None
        if label is None:
            size = body.nodes.size
            label = _cut(space.mesh, cells, graph, size, unknowns / block, partitioner)
            if body.shape is not None:
                cuts[body.shape] = label
        subdomains += [cells[group] for group in groups(label)]
    return subdomains


def _cut(
    domain: Mesh,
    cells: Indices,
    graph: sp.csr_matrix,
    size: int,
    nodes: float,
    partitioner: Partitioner,
) -> Numbers:
    """Return the connected part of each cell of a body with `size` nodes.

    Parts have about so many nodes: blocks, and slabs in space, with the copies of nodes that they
    share, others without.
    """
    points, cell_nodes = domain.geometry.x[:, : domain.geometry.dim], cell_vertices(domain)[cells]
    grid = find_grid(points, cell_nodes) if partitioner == "auto" else None
    if grid is not None:
        return components(graph, block_of_cells(grid, nodes))[1]
    count = min(round(size / nodes), cells.size)
    if partitioner == "scotch":
        return _by_scotch(graph, count)
    # by corners: faster than sums of short rows
    midpoints = sum(points[corner] for corner in cell_nodes.T) / cell_nodes.shape[1]
    # in two dimensions copies are few, and fewer in bodies that are cut along one axis
    own = cells_of_cube(nodes, 3) if points.shape[1] == 3 else nodes
    slabs = cut_into_slabs(graph, midpoints, min(round(size / own), cells.size))
    if partitioner == "slabs" or (aspect := mean_aspect(graph, midpoints, slabs)) < _ROUND:
        return slabs
    small = _by_scotch(graph, count)
    # rounding mixes what is near each other, such as the turns of a coil
    others = small, rounded(graph, midpoints, small)
    aspects = [aspect, *(mean_aspect(graph, midpoints, label) for label in others)]
    return (slabs, *others)[int(np.argmin(aspects))]


def _by_scotch(graph: sp.csr_matrix, count: int) -> Numbers:
    """Return connected parts with small interfaces."""
    label = _compat.partition_graph(graph.indptr, graph.indices, count).astype(np.int64)
    return components(graph, label)[1]


def as_subdomains(domain: Mesh, bodies: Bodies, labels: Sequence[int]) -> list[Indices]:
    """Return the connected cells of each of the user's labels, of one rank and one body."""
    label = np.asarray(labels)
    owned = owned_cells(domain)
    with raise_collectively(domain.comm):
        if label.shape != (owned,):
            raise InputError(
                f"'subdomains' has shape {label.shape}, but rank {domain.comm.rank} owns {owned} "
                "cells: give one label for each cell that the rank owns, without ghosts"
            )
    distinct, number = np.unique(label, return_inverse=True)
    body_and_label = bodies.of_cell * distinct.size + number
    subdomains = groups(components(bodies.graph, body_and_label)[1])
    if len(subdomains) > np.unique(body_and_label).size:
        logger.info(
            "rank %d: %d subdomain labels gave %d connected subdomains",
            domain.comm.rank,
            distinct.size,
            len(subdomains),
        )
    return subdomains
