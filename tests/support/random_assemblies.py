"""Random assemblies of boxes in a row: offsets, wavy faces, interference, small gaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.io import Box, boxes

_SIZES = [1e-6, 1e-3, 1e-2]
_LENGTH = 1.0


@dataclass(frozen=True)
class Assembly:
    """Boxes in a row along an axis, each in contact with the next one and with no others."""

    bodies: Any  # the tagged mesh
    axis: int
    joints: NDArray[
        np.float64
    ]  # (bodies - 1,): where each box but the last ends along the axis [m]
    overlaps: NDArray[np.float64]  # (bodies - 1,): area over which it and the next are in contact
    height: float  # of the gap or the interference and the waves [m]


def random_assembly(seed: int, comm: MPI.Intracomm) -> Assembly:
    """Draw an assembly of two to four boxes, in the plane or in space."""
    draw = np.random.default_rng(seed)
    dim, count = int(draw.integers(2, 4)), int(draw.integers(2, 5))
    axis, across = np.split(draw.permutation(dim), [1])
    gap = draw.choice([0.0, *_SIZES, *(-size for size in _SIZES)])
    wave = draw.choice([0.0, 0.0, *_SIZES])
    lower, upper = np.zeros((2, count, dim))
    for k in range(count):
        lower[k, axis] = k * (_LENGTH + gap)
        upper[k, axis] = lower[k, axis] + _LENGTH
        width = draw.choice([0.5, 1.0, 4.0], dim - 1)
        start = np.zeros(dim - 1)
        if k:
            before, end = lower[k - 1, across], upper[k - 1, across]
            # flush edges, or an offset to either side by at most 0.6 of the smaller width
            offset = draw.choice([0.0, 0.3, 0.6], dim - 1) * np.minimum(width, end - before)
            left = draw.random(dim - 1) < 0.5
            start = np.where(left, before - offset, end + offset - width)
        lower[k, across], upper[k, across] = start, start + width
    grid = np.ceil((upper - lower) * draw.uniform(1.5, 3.0, (count, 1))).astype(int)
    grid[:, axis] = draw.integers(1, 3, (count, 1))
    cell = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"][
        2 * (dim - 2) + draw.integers(2)
    ]
    parts = map(Box, lower.tolist(), upper.tolist(), grid.tolist())
    bodies = boxes(comm, list(parts), cell)
    x = bodies.mesh.geometry.x
    x[:, axis] += wave * np.sin(7.0 * x[:, across].sum(axis=1, keepdims=True))
    common = np.minimum(upper[:-1], upper[1:]) - np.maximum(lower[:-1], lower[1:])
    overlaps = np.prod(common[:, across], axis=1)
    return Assembly(bodies, int(axis[0]), upper[:-1, axis[0]], overlaps, abs(gap) + 2.0 * wave)
