"""Intersections of convex polygons in a plane, many at once (Sutherland and Hodgman 1974)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["clip_intervals", "clip_polygons", "fan_triangles"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Distance from an edge, relative to the edge's length, within which a point is on it.
_ON_EDGE = 1e-12


def clip_intervals(subject: Vector, clipper: Vector) -> Vector:
    """Intersect intervals.

    Parameters
    ----------
    subject, clipper : (k, 2) arrays
        Their ends, in either order.

    Returns
    -------
    (k, 2) array
        Lower and upper end; equal where the intersection is empty.
    """
    low = np.maximum(subject.min(axis=1), clipper.min(axis=1))
    high = np.minimum(subject.max(axis=1), clipper.max(axis=1))
    return np.column_stack([low, np.maximum(low, high)])


def clip_polygons(subject: Vector, clipper: Vector) -> tuple[Vector, Numbers]:
    """Cut polygons by the edges of convex ones.

    Parameters
    ----------
    subject : (k, m, 2) array
        Corners of the polygons that are cut, anticlockwise.
    clipper : (k, n, 2) array
        Corners of the convex polygons that cut them, anticlockwise.

    Returns
    -------
    corners, count : (k, c, 2) array, (k,) integer array
        The intersections, anticlockwise, and their numbers of corners, at most c; 0 for an empty
        one.
    """
    k, m, _ = subject.shape
    n = clipper.shape[1]
    x, y = subject[..., 0], subject[..., 1]
    count = np.full(k, m, dtype=np.int64)
    for edge in range(n):
        start, end = clipper[:, edge], clipper[:, (edge + 1) % n]
        x, y, count = _cut(x, y, count, start, end - start)
    count[count < 3] = 0
    return np.stack([x, y], axis=-1), count


def _cut(
    x: Vector, y: Vector, count: Numbers, start: Vector, along: Vector
) -> tuple[Vector, Vector, Numbers]:
    """Keep what is on the left of a line through `start` (k, 2) in the direction `along`."""
    slot = np.arange(x.shape[1])
    valid = slot < count[:, None]
    length = np.linalg.norm(along, axis=1)[:, None]
    tx, ty = along[:, :1] / length, along[:, 1:] / length
    distance = tx * (y - start[:, 1:]) - ty * (x - start[:, :1])
    inside = valid & (distance >= -_ON_EDGE * length)
    following = np.where(slot + 1 < count[:, None], slot + 1, 0)
    crosses = valid & (inside != np.take_along_axis(inside, following, axis=1))
    row, at = np.nonzero(crosses)
    to = following[row, at]
    # by signed distances, so that the point is on the edge also where lines are nearly parallel
    part = distance[row, at] / (distance[row, at] - distance[row, to])
    # each corner that is kept is followed by the crossing on the edge from it
    place = np.cumsum(inside.astype(np.int64) + crosses, axis=1) - 1
    new_count = place[:, -1] + 1
    shape = (len(x), max(1, int(new_count.max(initial=0))))
    kept = np.nonzero(inside)
    kept_place = (place - crosses)[kept]
    cut = []
    for values in (x, y):
        new = np.zeros(shape)
        new[kept[0], kept_place] = values[kept]
        new[row, place[row, at]] = values[row, at] + part * (values[row, to] - values[row, at])
        cut.append(new)
    return cut[0], cut[1], new_count


def fan_triangles(corners: Vector, count: Numbers) -> tuple[Numbers, Vector, Vector]:
    """Divide polygons into triangles with the common corner 0.

    Parameters
    ----------
    corners, count : (k, m, 2) array, (k,) integer array
        Polygons and their numbers of corners.

    Returns
    -------
    polygon, triangles, area : (t,) integer array, (t, 3, 2) array, (t,) array
        The polygon of each triangle, its corners, and its area, of either sign in polygons that
        are not convex.
    """
    number = np.maximum(count - 2, 0)
    polygon = np.repeat(np.arange(len(count)), number)
    first = np.repeat(np.cumsum(number) - number, number)
    at = np.arange(polygon.size) - first + 1
    triangles = np.stack(
        [corners[polygon, 0], corners[polygon, at], corners[polygon, at + 1]], axis=1
    )
    one, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = 0.5 * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    return polygon, triangles, area
