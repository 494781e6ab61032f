"""Two surfaces for mortar integrals: grids of quadrilaterals or triangles, chains of segments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.geometry.facets import Facets

Vector = NDArray[np.float64]


def flat(x: Vector, y: Vector) -> Vector:
    return 0.0 * x


def grid(
    cells: tuple[int, int],
    low: tuple[float, float] = (0.0, 0.0),
    high: tuple[float, float] = (1.0, 1.0),
    height: Callable[[Vector, Vector], Any] = flat,
    up: bool = True,
    corners: int = 3,
    jitter: float = 0.0,
    seed: int = 0,
) -> Facets:
    """Return the graph of a function over a rectangle; inner nodes are moved at random."""
    (nx, ny), random = cells, np.random.default_rng(seed)
    x, y = np.meshgrid(
        np.linspace(low[0], high[0], nx + 1), np.linspace(low[1], high[1], ny + 1), indexing="ij"
    )
    step = jitter * np.array([(high[0] - low[0]) / nx, (high[1] - low[1]) / ny])
    x[1:-1, 1:-1] += step[0] * (random.random((nx - 1, ny - 1)) - 0.5)
    y[1:-1, 1:-1] += step[1] * (random.random((nx - 1, ny - 1)) - 0.5)
    points = np.stack([x.ravel(), y.ravel(), height(x.ravel(), y.ravel())], axis=1)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    at = i * (ny + 1) + j
    facets = np.stack([at, at + ny + 1, at + ny + 2, at + 1], axis=1)
    if corners == 3:
        facets = np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])
    return Facets(points, facets if up else facets[:, ::-1])


def chain(x: Any, height: Callable[[Vector], Any] = np.zeros_like, up: bool = True) -> Facets:
    """Return the segments between points over increasing x."""
    x = np.asarray(x, dtype=float)
    ends = np.column_stack([np.arange(x.size - 1), np.arange(1, x.size)])
    # seen along a segment its normal points to the right
    return Facets(np.column_stack([x, height(x)]), ends[:, ::-1] if up else ends)
