"""Bodies whose nodes form a grid along the axes, cut into blocks that are equal where possible.

Equal blocks are congruent subdomains, which share their stiffness matrix and its factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Indices, Numbers, Vector

# part of all combinations of coordinates at which a grid has nodes
_LEAST_FILLED = 0.5


@dataclass(frozen=True)
class Grid:
    """The m cells of a body whose nodes form a tensor-product grid in d dimensions."""

    cell: Numbers  # (m, d) index of the grid box of each cell; the simplices of a box have the same
    cells: Numbers  # (d,) number of boxes along each axis
    lengths: Vector  # (d,) of the body [m]


def find_grid(points: Vector, cell_nodes: Numbers | Indices) -> Grid | None:
    """Return the grid along the axes that points (k, d) at cells (m, v) form, or None.

    At least half of all combinations of coordinates are at one node and none is at two: corners of
    the body may be missing, and so may boxes on other ranks.
    """
    # a thousand cells tell that most meshes are no grids: their nodes have too many coordinates
    sample = np.unique(cell_nodes[:: len(cell_nodes) // 1000 + 1])
    if _LEAST_FILLED * _combinations(_indices(points[sample])) > cell_nodes.size:
        return None
    nodes, positions = np.unique(cell_nodes, return_inverse=True)
    index = _indices(points[nodes])
    if _LEAST_FILLED * _combinations(index) > nodes.size:
        return None
    shape = index.max(axis=0) + 1
    if np.unique(np.ravel_multi_index(tuple(index.T), tuple(shape))).size < nodes.size:
        return None
    cell = index[positions.reshape(cell_nodes.shape)].min(axis=1)
    return Grid(cell, shape - 1, np.ptp(points[nodes], axis=0))


def _indices(points: Vector) -> Numbers:
    """Return for each point and axis the number of different smaller coordinates."""
    tolerance = RELATIVE_ROUNDING * np.ptp(points, axis=0).max()
    index = np.empty(points.shape, dtype=np.int64)
    for axis, x in enumerate(points.T):
        order = np.argsort(x)
        index[order, axis] = np.cumsum(np.diff(x[order], prepend=x[order[:1]]) > tolerance)
    return index


def _combinations(index: Numbers) -> float:
    """Return the number of combinations of coordinates, which may be too large for an integer."""
    return float(np.prod(index.max(axis=0) + 1.0))


def cells_of_cube(nodes: float, dim: int) -> float:
    """Return the number of cells of a cube with so many nodes.

    It is that of the nodes that are left if each one on the sides counts for one of the cubes.
    """
    edge: float = nodes ** (1.0 / dim) - 1.0
    return float(max(edge, 1.0) ** dim)


def block_of_cells(grid: Grid, nodes: float) -> Numbers:
    """Cut a grid into equal blocks, nearly cubes of about so many nodes; label the cells (m,)."""
    dim = grid.cells.size
    blocks = max(float(np.prod(grid.cells)) / cells_of_cube(nodes, dim), 1.0)
    edge = (np.prod(grid.lengths) / blocks) ** (1.0 / dim)
    counts = [
        _blocks_along(int(n), length / edge)
        for n, length in zip(grid.cells, grid.lengths, strict=True)
    ]
    index = [(grid.cell[:, axis] * count) // grid.cells[axis] for axis, count in enumerate(counts)]
    return np.ravel_multi_index(tuple(index), tuple(counts))


def _blocks_along(cells: int, target: float) -> int:
    """Return the number of blocks along an axis, preferably one that divides the cells.

    A divisor is taken if it differs from the wanted number by no more than a factor of 1.4.
    """
    largest_factor = 1.4
    target = min(max(target, 1.0), float(cells))
    counts = np.arange(1, min(cells, int(2.0 * target) + 1) + 1)
    factor = np.maximum(counts / target, target / counts)
    divides = (cells % counts == 0) & (factor <= largest_factor)
    return int(counts[np.argmin(np.where(divides, factor, factor + largest_factor))])
