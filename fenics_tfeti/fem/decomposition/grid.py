"""Bodies whose nodes are a grid along the axes, cut into blocks that are equal if possible.

Equal blocks are congruent subdomains, which share their assembly and their factor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Grid", "block_of_cells", "find_grid"]

Points = NDArray[np.float64]
Numbers = NDArray[np.int64]

# relative to the body: difference of coordinates that are meant to be equal
_SAME = 1e-9
# part of the places of a grid at which there have to be nodes: bodies may have corners cut out, and
# parts of them on several ranks have steps
_FILLED = 0.5
# by how much the number of blocks along an axis may miss what would make cubes, to come out even
_LEEWAY = 1.4


@dataclass(frozen=True)
class Grid:
    """The cells of a body whose nodes are on a tensor-product grid.

    Attributes
    ----------
    cell : (m, d) integer array
        Of each cell its place along each axis; the simplices of one box have the same.
    cells : (d,) integer array
        Number of places along each axis.
    lengths : (d,) array
        The body's [m].
    """

    cell: Numbers
    cells: Numbers
    lengths: Points


def find_grid(points: Points, cell_nodes: Numbers) -> Grid | None:
    """Find out whether nodes are a grid along the axes, from their coordinates alone.

    Parameters
    ----------
    points : (k, d) array
        The body's nodes [m].
    cell_nodes : (m, v) integer array
        The nodes of its cells.

    Returns
    -------
    Grid or None
        None unless most combinations of coordinates are at one node, and none at two.

    Examples
    --------
    >>> import numpy as np
    >>> points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 3.0], [1.0, 3.0]])
    >>> find_grid(points, np.array([[0, 1, 2], [1, 2, 3]])).cells.tolist()
    [1, 1]
    """
    if len(points) == 0:
        return None
    lengths = np.ptp(points, axis=0)
    steps = np.stack([_steps(x, _SAME * lengths.max()) for x in points.T], axis=1)
    shape = steps.max(axis=0) + 1
    # as floats: of an unstructured mesh every coordinate is another one
    if len(points) < _FILLED * np.prod(shape.astype(float)):
        return None
    if np.unique(np.ravel_multi_index(tuple(steps.T), tuple(shape))).size < len(points):
        return None
    return Grid(steps[cell_nodes].min(axis=1), shape - 1, lengths)


def block_of_cells(grid: Grid, nodes: float) -> Numbers:
    """Cut a grid into blocks that are as nearly cubes as coming out even allows.

    Parameters
    ----------
    grid : Grid
        The cells.
    nodes : float
        Nodes of a block to aim at.

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
    places = [(grid.cell[:, axis] * count) // grid.cells[axis] for axis, count in enumerate(counts)]
    block: Numbers = np.ravel_multi_index(tuple(places), tuple(counts))
    return block


def _steps(x: Points, same: float) -> Numbers:
    """Return of each coordinate how many different smaller ones there are."""
    order = np.argsort(x)
    steps = np.empty(x.size, dtype=np.int64)
    steps[order] = np.cumsum(np.diff(x[order], prepend=x[order[:1]]) > same)
    return steps


def _blocks_along(cells: int, wanted: float) -> int:
    """Return the number of blocks along an axis: one that divides the cells, if one is near."""
    wanted = min(max(wanted, 1.0), float(cells))
    counts = np.arange(1, min(cells, int(2.0 * wanted) + 1) + 1)
    miss = np.maximum(counts / wanted, wanted / counts)
    even = (cells % counts == 0) & (miss <= _LEEWAY)
    return int(counts[np.argmin(np.where(even, miss, miss + _LEEWAY))])
