"""Initial gaps other than those of the mesh: none between touching surfaces, or prescribed ones."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair
from fenics_tfeti.fem.user_data import scalars_at
from fenics_tfeti.typing import Numbers, Vector


def chord_heights(
    corners: Vector, normals: Vector, middles: Vector | None = None
) -> tuple[Vector, Vector]:
    """Return distances (f,) of facets from curved surfaces through their nodes, with normals [m].

    Between two corners it is the height of a circle's segment, length times angle / 8. Inside a
    triangle it is up to 4/3 of that between two of its corners, inside a quadrilateral that between
    the ends of a diagonal. Nodes in the middle take their own height off it; what is left is the
    height of the two halves, a quarter, and the difference. The second result are the distances
    less the curvature of the facets: next to none for degree 2. Corners and unit normals are (f, v,
    gdim), the other nodes of facets of degree 2 (f, t - v, gdim), see `Facets`.

    Examples
    --------
    A chord of 0.2 m of a circle with radius 1 m.

    >>> angle = np.array([-0.1, 0.1])
    >>> ends = np.stack([np.sin(angle), np.cos(angle)], axis=1)[None]
    >>> float(np.round(chord_heights(ends, ends)[0][0], 6)), float(np.round(1 - np.cos(0.1), 6))
    (0.004983, 0.004996)
    """
    v = corners.shape[1]
    heights, node_heights = [], []
    for i, j in combinations(range(v), 2):
        edge, turn = corners[:, j] - corners[:, i], normals[:, j] - normals[:, i]
        # the part along the edge: on an edge oblique to the axis of a cylinder, normals turn aside
        heights.append(np.abs(np.einsum("fd,fd->f", edge, turn)) / 8.0)
        middle = 0.5 * (corners[:, i] + corners[:, j])
        node = middle if middles is None else middles[:, _middle(i, j, v)]
        node_heights.append(np.linalg.norm(node - middle, axis=1))
    height, node_height = np.array(heights), np.array(node_heights)
    chord = np.abs(height - node_height) + node_height / 4.0
    deviation = np.maximum(height - node_height, 0.0)
    in_facet = 4.0 / 3.0 if v == 3 else 1.0
    return in_facet * chord.max(axis=0), in_facet * deviation.max(axis=0)


def _middle(i: int, j: int, v: int) -> int:
    """Return which of the other nodes of a facet of degree 2 is between two corners i < j."""
    if j == i + 1:
        return i
    return v - 1 if j == v - 1 and i == 0 else v


def initial_gaps(
    comm: MPI.Intracomm,
    pairs: Sequence[ContactPair],
    contact: Numbers,
    gap: Vector,
    chord: Vector,
    points: Vector,
    names: Sequence[str],
) -> Vector:
    """Return the initial gaps (k,) of conditions of contacts (k,). Collective.

    For the values see `ContactPair`. The gaps (k,) are those of the mesh, the chords the distances
    of its facets from the curved surfaces there [m].
    """
    touching = np.array([pair.initial_gap == "touching" for pair in pairs])
    # twice: the normals at a surface's border see half of the curvature
    gap = np.where(touching[contact] & (np.abs(gap) <= 2.0 * chord), 0.0, gap)
    for k, (pair, name) in enumerate(zip(pairs, names, strict=True)):
        if not isinstance(pair.initial_gap, str):
            rows = contact == k
            gap[rows] = user_gaps(comm, pair.initial_gap, points[rows], name)
    return gap


def user_gaps(comm: MPI.Intracomm, value: Any, points: Vector, name: str) -> Vector:
    """Evaluate the gaps (k,) that a user gives at points (k, 3). Collective."""
    return scalars_at(comm, value, points, points.shape[1], f"{name}: initial_gap")
