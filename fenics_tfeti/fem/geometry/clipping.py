"""Intersections of convex polygons in a plane, many at once (Sutherland and Hodgman 1974)."""

from __future__ import annotations

import numpy as np

from fenics_tfeti.typing import Mask, Numbers, Vector


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
    # corner by corner, each for all polygons: (m, k)
    x, y = np.ascontiguousarray(subject[..., 0].T), np.ascontiguousarray(subject[..., 1].T)
    row, count = np.arange(len(subject)), np.full(len(subject), len(x), dtype=np.int64)
    for edge in range(n):
        start, end = clipper[row, edge].T, clipper[row, (edge + 1) % n].T
        x, y, count, kept = _cut(x, y, count, start, end - start)
        row = row[kept]
    corners, number = np.zeros((len(subject), len(x), 2)), np.zeros(len(subject), dtype=np.int64)
    corners[row, :, 0], corners[row, :, 1] = x.T, y.T
    number[row] = np.where(count < 3, 0, count)
    return corners, number


def _cut(
    x: Vector, y: Vector, count: Numbers, start: Vector, direction: Vector
) -> tuple[Vector, Vector, Numbers, Mask]:
    """Keep what is on the left of lines through `start` (2, k) along `direction` (2, k).

    The corners are (m, k). Polygons of which nothing is left are taken out; the last result is the
    mask of the others. Most polygons are on one side of most lines.
    """
    length = np.hypot(*direction)
    tx, ty = direction / length
    distance = tx * (y - start[1]) - ty * (x - start[0])
    on_edge = 1e-12 * length
    inside = distance >= -on_edge
    inside &= np.arange(len(x))[:, None] < count
    number = inside.sum(axis=0)
    kept = number > 0
    divided = np.flatnonzero(kept & (number < count))
    old, new, part, following, new_count = _divide(
        inside.take(divided, axis=1), distance.take(divided, axis=1), count.take(divided)
    )
    count = count.copy()
    count[divided] = new_count
    size = max(1, int(count[kept].max(initial=0)))
    result = []
    for values in (x, y):
        ends = values.take(divided, axis=1).ravel()
        start_value = ends.take(old)
        divided_values = np.zeros(size * divided.size)
        divided_values[new] = start_value + part * (ends.take(following) - start_value)
        whole = np.zeros((size, kept.size))
        whole[: len(x)] = values[:size]
        whole[:, divided] = divided_values.reshape(size, -1)
        result.append(whole if kept.all() else whole[:, kept])
    return result[0], result[1], count[kept], kept


def _divide(
    inside: Mask, distance: Vector, count: Numbers
) -> tuple[Numbers, Numbers, Vector, Numbers, Numbers]:
    """Find the corners of polygons (m, k) that a line divides, of which those `inside` stay.

    The results (p,) `old` and `new` are the places in arrays of corners (., k), flattened, that the
    new corners come from and go to; each is the fraction `part` of the way from the old corner to
    the `following` one, 0 for a corner that stays. The last are the new numbers of corners (k,).
    """
    k = count.size
    slot = np.arange(len(inside))[:, None]
    last = slot + 1 == count
    crosses = inside != np.where(last, inside[:1], np.roll(inside, -1, axis=0))
    crosses &= slot < count
    # each corner that is kept is followed by the crossing on the edge from it
    place = np.cumsum(inside.astype(np.int64) + crosses, axis=0) - 1
    kept, crossed = np.flatnonzero(inside), np.flatnonzero(crosses)
    column = crossed % k if k else crossed
    successor = np.where(last.ravel().take(crossed), column, crossed + k)
    start, end = distance.ravel().take(crossed), distance.ravel().take(successor)
    # by signed distances, so that the point is on the edge also where lines are nearly parallel
    part = np.concatenate([np.zeros(kept.size), start / (start - end)])
    new_slot = np.concatenate([(place - crosses).ravel().take(kept), place.ravel().take(crossed)])
    old = np.concatenate([kept, crossed])
    new = new_slot * k + (old % k if k else old)
    return old, new, part, np.concatenate([kept, successor]), place[-1] + 1


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
