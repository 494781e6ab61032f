"""Bodies whose nodes form a grid along the axes, cut into blocks that are equal where possible.

Equal blocks are congruent subdomains, which share their stiffness matrix and its factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING

__all__ = ["Grid", "block_of_cells", "find_grid"]

Points = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Grid:
    """The cells of a body whose nodes form a tensor-product grid.

    Attributes
    ----------
    cell : (m, d) integer array
        Index along each axis of the grid box of each cell; the simplices of one box have the same.
    cells : (d,) integer array
        Number of boxes along each axis.
    lengths : (d,) array
        The body's [m].
    """

    cell: Numbers
    cells: Numbers
    lengths: Points


def find_grid(points: Points, cell_nodes: Numbers) -> Grid | None:
    """Find out from coordinates whether nodes form a grid along the axes.

    Parameters
    ----------
    points : (k, d) array
        The body's nodes [m].
    cell_nodes : (m, v) integer array
        The nodes of its cells.

    Returns
    -------
    Grid or None
        A grid if at least half of all combinations of coordinates are at one node and none is at
        two: corners of the body may be missing, and so may boxes on other ranks.

    Examples
    --------
    >>> import numpy as np
    >>> points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [1.0, 3.0]])
    >>> find_grid(points, np.array([[0, 1, 2], [1, 2, 3]])).cells.tolist()
    [1, 1]
    """
    least_filled = 0.5
    if len(points) == 0:
        return None
    lengths = np.ptp(points, axis=0)
    same = RELATIVE_ROUNDING * lengths.max()
    index = np.stack([_grid_index(x, same) for x in points.T], axis=1)
    shape = index.max(axis=0) + 1
    # as floats: all coordinates of an unstructured mesh differ, and the product overflows
    if len(points) < least_filled * np.prod(shape.astype(float)):
        return None
    if np.unique(np.ravel_multi_index(tuple(index.T), tuple(shape))).size < len(points):
        return None
    return Grid(index[cell_nodes].min(axis=1), shape - 1, lengths)


def block_of_cells(grid: Grid, nodes: float) -> Numbers:
    """Cut a grid into equal blocks that are nearly cubes.

    Parameters
    ----------
    grid : Grid
        The cells.
    nodes : float
        Wanted number of nodes of a block.

    Returns
    -------
    (m,) integer array
        The block of each cell.
    """
    dim = grid.cells.size
    cells_of_block = max(nodes ** (1.0 / dim) - 1.0, 1.0) ** dim
    blocks = max(np.prod(grid.cells) / cells_of_block, 1.0)
    edge = (np.prod(grid.lengths) / blocks) ** (1.0 / dim)
    counts = [
        _blocks_along(int(n), length / edge)
        for n, length in zip(grid.cells, grid.lengths, strict=True)
    ]
    index = [(grid.cell[:, axis] * count) // grid.cells[axis] for axis, count in enumerate(counts)]
    block: Numbers = np.ravel_multi_index(tuple(index), tuple(counts))
    return block


def _grid_index(x: Points, same: float) -> Numbers:
    """Return for each coordinate the number of different smaller ones."""
    order = np.argsort(x)
    index = np.empty(x.size, dtype=np.int64)
    index[order] = np.cumsum(np.diff(x[order], prepend=x[order[:1]]) > same)
    return index


def _blocks_along(cells: int, wanted: float) -> int:
    """Return the number of blocks along an axis, preferably one that divides the cells.

    A divisor is taken if it differs from the wanted number by no more than a factor of 1.4.
    """
    largest_factor = 1.4
    wanted = min(max(wanted, 1.0), float(cells))
    counts = np.arange(1, min(cells, int(2.0 * wanted) + 1) + 1)
    factor = np.maximum(counts / wanted, wanted / counts)
    divides = (cells % counts == 0) & (factor <= largest_factor)
    return int(counts[np.argmin(np.where(divides, factor, factor + largest_factor))])
