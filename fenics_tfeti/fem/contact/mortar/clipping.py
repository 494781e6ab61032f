"""Intersections of convex polygons in a plane, many at once (Sutherland and Hodgman 1974)."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.typing import Numbers, Vector


def clip_intervals(subject: Vector, clipper: Vector) -> Vector:
    """Intersect intervals (k, 2): lower and upper ends, which are equal where these are apart."""
    low = np.maximum(subject.min(axis=1), clipper.min(axis=1))
    high = np.minimum(subject.max(axis=1), clipper.max(axis=1))
    return np.column_stack([low, np.maximum(low, high)])


def clip_polygons(subject: Vector, clipper: Vector) -> tuple[Vector, Numbers]:
    """Cut polygons (k, m, 2) by the edges of convex ones (k, n, 2), corners anticlockwise.

    The results are the corners (k, c, 2) of the intersections, anticlockwise, and their numbers
    (k,), 0 for an empty one.
    """
    n = clipper.shape[1]
    # corner by corner, each for all polygons: (m, 2, k); the last one is repeated
    x = np.ascontiguousarray(np.moveaxis(subject, 0, -1))
    row, count = np.arange(len(subject)), np.full(len(subject), len(x), dtype=np.int64)
    for edge in range(n):
        start, end = clipper[row, edge].T, clipper[row, (edge + 1) % n].T
        x, count, kept = _cut(x, count, start, end - start)
        row = row[kept]
    corners, number = np.zeros((len(subject), len(x), 2)), np.zeros(len(subject), dtype=np.int64)
    corners[row] = np.moveaxis(x, -1, 0)
    number[row] = np.where(count < 3, 0, count)
    return corners, number


def _cut(
    x: Vector, count: Numbers, start: Vector, direction: Vector
) -> tuple[Vector, Numbers, Numbers]:
    """Keep what is on the left of lines through `start` (2, k) along `direction` (2, k).

    The corners are (m, 2, k). Polygons of which nothing is left are taken out; the last result are
    the positions of the others. Most polygons are on one side of most lines.
    """
    slots, length = np.arange(len(x)), np.hypot(*direction)
    tx, ty = direction / length
    distance = tx * (x[:, 1] - start[1]) - ty * (x[:, 0] - start[0])
    on_edge = 1e-12 * length
    inside = distance >= -on_edge
    kept = np.flatnonzero(inside.any(axis=0))
    x, count = x.take(kept, axis=2), count[kept]
    inside, distance = inside.take(kept, axis=1), distance.take(kept, axis=1)
    divided = np.flatnonzero(~inside.all(axis=0))
    ends, inside = x.take(divided, axis=2), inside.take(divided, axis=1)
    distance = distance.take(divided, axis=1)
    following = np.roll(slots, -1)
    crosses = inside != inside[following]
    # by signed distances, so that the point is on the edge also where lines are nearly parallel
    part = distance / np.where(crosses, distance - distance[following], 1.0)
    crossings = ends + part[:, None] * (ends[following] - ends)
    # each corner that is kept is followed by the crossing on the edge from it
    corner = inside & (slots[:, None] < count[divided])
    chosen = np.stack([corner, crosses], axis=1).reshape(2 * len(x), -1)
    points = np.stack([ends, crossings], axis=1).reshape(2 * len(x), 2, -1)
    count[divided] = chosen.sum(axis=0)
    size = np.arange(count.max(initial=1))
    order = np.argsort(~chosen, axis=0, kind="stable")
    order = np.take_along_axis(order, np.minimum(size[:, None], count[divided] - 1), axis=0)
    x = x[np.minimum(size, slots[-1])]
    x[..., divided] = np.take_along_axis(points, order[:, None], axis=0)
    return x, count, kept


def fan_triangles(corners: Vector, count: Numbers) -> tuple[Numbers, Vector, Vector]:
    """Divide polygons (k, m, 2) with `count` corners into triangles with the common corner 0.

    Returned are the polygon (t,) of each triangle, its corners (t, 3, 2), and its area (t,), of
    either sign in polygons that are not convex.
    """
    number = np.maximum(count - 2, 0)
    polygon = np.repeat(np.arange(len(count)), number)
    first = np.repeat(np.cumsum(number) - number, number)
    corner = np.arange(polygon.size) - first + 1
    triangles = np.stack(
        [corners[polygon, 0], corners[polygon, corner], corners[polygon, corner + 1]], axis=1
    )
    u, w = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = 0.5 * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
    return polygon, triangles, area
