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
from fenics_tfeti.typing import Numbers, Points

# nodes that are compared first
_PROBES = 16
# nodes that may be the image of the first one: of sets such as spherical shells, of which there are
# more, no images are looked for
_MOST = 1000
# entries of an orthogonal matrix that are rounding
_ZERO = 1e-15


def find_images(points: Points, reference: Points) -> Iterator[tuple[Points, Numbers]]:
    """Find the rotations and mirrorings by which points are the images of reference points.

    There are several for symmetric sets, rotations first, and some may come twice. None are found
    for sets of which more than a thousand points may be the image of any one.

    Parameters
    ----------
    points, reference : (k, d) arrays
        Coordinates in the plane or in space.

    Yields
    ------
    turn : (d, d) array
        Orthogonal matrix T: points[order] = reference T' but for a translation.
    order : (k,) integer array
        The point that is the image of each reference point.

    Examples
    --------
    >>> import numpy as np
    >>> corner = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 1.0]])
    >>> moved = np.array([[5.0, 5.0], [5.0, 8.0], [4.0, 5.0]])
    >>> turn, order = next(find_images(moved, corner))
    >>> turn.round(12).tolist(), order.tolist()
    ([[0.0, -1.0], [1.0, 0.0]], [0, 1, 2])
    """
    if points.shape != reference.shape:
        return
    largest = max(np.abs(points).max(), np.abs(reference).max())
    x, y = points - points.mean(axis=0), reference - reference.mean(axis=0)
    radii = np.linalg.norm(y, axis=1)
    same = RELATIVE_ROUNDING * float(radii.max())
    if np.abs(np.sort(np.linalg.norm(x, axis=1)) - np.sort(radii)).max() > same:
        return
    tree = cKDTree(x)
    probes = np.unique(np.linspace(0, len(y) - 1, _PROBES).astype(int))
    for turn in _candidates(x, y, same):
        if tree.query(y[probes] @ turn.T)[0].max() > same:
            continue
        distance, order = tree.query(y @ turn.T)
        if distance.max() > same or np.unique(order).size < order.size:
            continue
        turn = _nearest_orthogonal(x[order].T @ y)
        if np.abs(x[order] - y @ turn.T).max() <= COORDINATE_ROUNDING * largest:
            yield turn, order


def _candidates(x: Points, y: Points, same: float) -> Iterator[Points]:
    """Return the orthogonal matrices that take the chosen nodes of y to nodes of x."""
    first = _rarest(np.linalg.norm(y, axis=1)[:, None], same)
    a = y[first]
    at = np.flatnonzero(np.abs(np.linalg.norm(x, axis=1) - np.linalg.norm(a)) <= same)
    if at.size > _MOST:
        return
    if y.shape[1] == 2:
        own, pairs = a[None], [x[i][None] for i in at]
    else:
        second = _rarest(_places(y, a), same)
        b = y[second]
        along = _places(b[None], a)
        own = np.stack([a, b])
        pairs = [
            np.stack([x[i], x[j]])
            for i in at
            for j in np.flatnonzero(np.abs(_places(x, x[i]) - along).max(axis=1) <= same)
        ]
    basis = _basis(own)
    for side in (1.0, -1.0):
        for images in pairs:
            image = _basis(images)
            image[-1] *= side
            yield image.T @ basis


def _places(x: Points, axis: Points) -> Points:
    """Return the distances of points from an axis through the centre, and the places along it."""
    along = x @ (axis / np.linalg.norm(axis))
    across = np.linalg.norm(x - along[:, None] * axis / np.linalg.norm(axis), axis=1)
    return np.stack([across, along], axis=1)


def _rarest(measures: Points, same: float) -> int:
    """Return the point, far out in the first measure, that shares its measures with fewest."""
    far = np.flatnonzero(measures[:, 0] >= 0.5 * measures[:, 0].max())
    shared = cKDTree(measures).query_ball_point(measures[far], same, return_length=True)
    return int(far[np.lexsort([-measures[far, 0], shared])[0]])


def _basis(vectors: Points) -> Points:
    """Return an orthonormal basis, as rows, whose first vectors span those given."""
    e = vectors[0] / np.linalg.norm(vectors[0])
    if len(vectors) == 1:
        return np.array([e, [-e[1], e[0]]])
    f = vectors[1] - (vectors[1] @ e) * e
    f /= np.linalg.norm(f)
    return np.array([e, f, np.cross(e, f)])


def _nearest_orthogonal(matrix: Points) -> Points:
    left, _, right = np.linalg.svd(matrix)
    turn: Points = left @ right
    return np.where(np.abs(turn) < _ZERO, 0.0, turn)
