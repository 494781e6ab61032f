"""Rotated and mirrored images of sets of nodes: the orthogonal matrix and the pairs of nodes.

Two nodes and the centre of one set (in the plane one node) fix the matrix, up to a mirroring, once
the nodes are known that are their images. Those have equal distances, from the centre and from each
other. The nodes are chosen such that few others have the same.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, RELATIVE_ROUNDING
from fenics_tfeti.typing import Numbers, Vector


def find_images(points: Vector, reference: Vector) -> Iterator[tuple[Vector, Numbers]]:
    """Find the rotations and mirrorings by which points are the images of reference points.

    Yield an orthogonal matrix T and an order with points[order] = reference T' but for a
    translation; both sets are (k, d), in the plane or in space. There are several for symmetric
    sets, rotations first, and some may come twice. None are found for sets of which more than a
    thousand points may be the image of any one.
    """
    if points.shape != reference.shape:
        return
    largest = max(np.abs(points).max(), np.abs(reference).max())
    x, y = points - points.mean(axis=0), reference - reference.mean(axis=0)
    tolerance = RELATIVE_ROUNDING * float(np.linalg.norm(y, axis=1).max())
    tree = cKDTree(x)
    # nodes that are compared first
    probes = np.unique(np.linspace(0, len(y) - 1, 16).astype(int))
    for rotation in _candidates(x, y, tolerance):
        if tree.query(y[probes] @ rotation.T)[0].max() > tolerance:
            continue
        distance, order = tree.query(y @ rotation.T)
        if distance.max() > tolerance or np.unique(order).size < order.size:
            continue
        left, _, right = np.linalg.svd(x[order].T @ y)
        rotation = left @ right  # the nearest orthogonal matrix
        rotation[np.abs(rotation) < 1e-15] = 0.0  # rounding
        if np.abs(x[order] - y @ rotation.T).max() <= COORDINATE_ROUNDING * largest:
            yield rotation, order


def _candidates(x: Vector, y: Vector, tolerance: float) -> Iterator[Vector]:
    """Return the orthogonal matrices that take the chosen nodes of y to nodes of x."""
    first = _rarest(np.linalg.norm(y, axis=1)[:, None], tolerance)
    a = y[first]
    candidates = np.flatnonzero(np.abs(np.linalg.norm(x, axis=1) - np.linalg.norm(a)) <= tolerance)
    if candidates.size > 1000:  # as of spherical shells
        return
    if y.shape[1] == 2:
        vectors, pairs = a[None], [x[i][None] for i in candidates]
    else:
        second = _rarest(_places(y, a), tolerance)
        b = y[second]
        place = _places(b[None], a)
        vectors = np.stack([a, b])
        pairs = [
            np.stack([x[i], x[j]])
            for i in candidates
            for j in np.flatnonzero(np.abs(_places(x, x[i]) - place).max(axis=1) <= tolerance)
        ]
    basis = _basis(vectors)
    for side in (1.0, -1.0):
        for images in pairs:
            image = _basis(images)
            image[-1] *= side
            yield image.T @ basis


def _places(x: Vector, axis: Vector) -> Vector:
    """Return the distances of points from an axis through the centre, and the places along it."""
    place = x @ (axis / np.linalg.norm(axis))
    distance = np.linalg.norm(x - place[:, None] * axis / np.linalg.norm(axis), axis=1)
    return np.stack([distance, place], axis=1)


def _rarest(measures: Vector, tolerance: float) -> int:
    """Return the point, far out in the first measure, that shares its measures with fewest."""
    outer = np.flatnonzero(measures[:, 0] >= 0.5 * measures[:, 0].max())
    shared = cKDTree(measures).query_ball_point(measures[outer], tolerance, return_length=True)
    return int(outer[np.lexsort([-measures[outer, 0], shared])[0]])


def _basis(vectors: Vector) -> Vector:
    """Return an orthonormal basis, as rows, whose first vectors span those given."""
    e = vectors[0] / np.linalg.norm(vectors[0])
    if len(vectors) == 1:
        return np.array([e, [-e[1], e[0]]])
    f = vectors[1] - (vectors[1] @ e) * e
    f /= np.linalg.norm(f)
    return np.array([e, f, np.cross(e, f)])
