"""Oriented surfaces of segments or triangles: signed distances, and where lines meet them.

Nothing here knows dolfinx or communicates. The facets are sorted into a tree of boxes, which is
descended for all points at once, so that every answer is exact and a point costs as many boxes as
the tree has levels, whatever the shapes and sizes of the facets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["Distance", "FacetedSurface", "facet_normals"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]

# facets in a box that is not divided any further
_LEAF = 2
# points that descend the tree at once; bounds the memory where many facets are equally far
_BLOCK = 2048
# of barycentric coordinates: closer to a corner or an edge than this is upon it
_CORNER = 1e-12
# of barycentric coordinates: what a line may miss a facet by, so that none slips between two
_CRACK = 1e-9
# a line counts as meeting a facet if the cosine of their normals' angle is larger
_GRAZING = 1e-9
# the gap along a line is at most so many times the distance: lines up to 60 degrees off count
_OBLIQUE = 2.0


@dataclass(frozen=True)
class Distance:
    """Where points are with respect to a surface.

    Attributes
    ----------
    signed : (k,) array
        Distance to the surface, negative inside the body [m].
    normal : (k, gdim) array
        Unit vectors along which it grows: from the closest point to a point outside, and from a
        point inside to the closest one. On the surface its outward normal, at an edge the mean of
        the adjacent facets', at a vertex weighted with their angles.
    beside : (k,) bool array
        Whether the point is beside the border of the surface, by no more than half a facet: there
        the surface counts as continued by the plane across its normal at the border, `signed` and
        `normal` are those of the plane.
    """

    signed: Vector
    normal: Vector
    beside: Mask


def facet_normals(corners: Vector) -> Vector:
    """Return the normals of segments or triangles, as long as their length or area.

    Parameters
    ----------
    corners : (m, gdim, gdim) array
        The corners of each: a segment has its normal on the right, the corners of a triangle
        circle it anticlockwise.

    Returns
    -------
    (m, gdim) array
        The normals.
    """
    along = corners[:, 1:] - corners[:, :1]
    if corners.shape[2] == 2:
        return np.column_stack([along[:, 0, 1], -along[:, 0, 0]])
    normals: Vector = 0.5 * np.cross(along[:, 0], along[:, 1])
    return normals


class FacetedSurface:
    """An oriented surface, open or closed, on every rank as a whole.

    Parameters
    ----------
    points : (n, gdim) array
        [m].
    facets : (m, gdim) integer array
        Corners of segments (2D) or triangles (3D) as rows of `points`, oriented outwards as
        `facet_normals` says.
    """

    def __init__(self, points: Vector, facets: Numbers) -> None:
        self._corners = points[facets]
        areas = facet_normals(self._corners)
        self._normals = _unit(areas)
        self._middles = cKDTree(self._corners.mean(axis=1))
        self._tree = _BoxTree(self._corners)
        self._rounding = 1e-14 * float(np.abs(points).max(initial=0.0))
        self._describe_features(facets)

    def _describe_features(self, facets: Numbers) -> None:
        """Find normals, border and half the size at corners, edges (3D) and insides of facets.

        The normals at edges and vertices are those whose sign tells inside from outside
        (Baerentzen and Aanaes 2005).
        """
        m, gdim = facets.shape
        sizes = _edge_lengths(self._corners).max(axis=1)
        if gdim == 2:
            weights, keys = np.ones((m, 2)), facets
            border = np.bincount(facets.ravel())[facets] == 1
        else:
            ends = np.sort(np.stack([facets, np.roll(facets, -1, axis=1)], axis=2), axis=2)
            number = int(facets.max()) + 1
            names, edges = np.unique(ends @ np.array([number, 1]), return_inverse=True)
            edges = edges.reshape(m, 3)
            border_edge = np.bincount(edges.ravel())[edges] == 1
            on_border = np.zeros(number, dtype=bool)
            on_border[ends[border_edge].ravel()] = True
            border = np.hstack([on_border[facets], border_edge])
            weights = np.hstack([_angles(self._corners), np.ones((m, 3))])
            keys = np.hstack([facets, number + edges])
        normals = np.zeros((int(keys.max()) + 1, gdim))
        np.add.at(normals, keys, weights[:, :, None] * self._normals[:, None, :])
        halves = np.zeros(len(normals))
        np.maximum.at(halves, keys, 0.5 * np.broadcast_to(sizes[:, None], keys.shape))
        inside = np.zeros((m, 1), dtype=bool)
        self._feature_normals = np.concatenate(
            [_unit(normals)[keys], self._normals[:, None, :]], axis=1
        )
        self._feature_border = np.hstack([border, inside])
        self._feature_half = np.hstack([halves[keys], 0.5 * sizes[:, None]])

    def distance(self, x: Vector) -> Distance:
        """Find the distances of points to the surface, with signs.

        A point is inside if it is behind the closest point of the surface. Beside the border of
        an open surface, where nothing is known of the body, a point within half a facet is
        measured from the plane that continues the surface there, one farther away is outside.

        Parameters
        ----------
        x : (k, gdim) array
            The points [m].

        Returns
        -------
        Distance
            Of each of them.
        """
        blocks = [self._closest(part) for part in _blocks(x)]
        point, facet, feature = (np.concatenate(column) for column in zip(*blocks, strict=True))
        normal = self._feature_normals[facet, feature]
        offset = x - point
        length = np.linalg.norm(offset, axis=1)
        height = np.sum(offset * normal, axis=1)
        aside = np.linalg.norm(offset - height[:, None] * normal, axis=1)
        border = self._feature_border[facet, feature]
        beside = border & (aside <= self._feature_half[facet, feature])
        signed = np.where(beside, height, np.where(border | (height >= 0.0), length, -length))
        away = ~beside & (length > self._rounding)
        normal[away] = offset[away] / signed[away, None]
        return Distance(signed, normal, beside)

    def closest(self, x: Vector) -> tuple[Numbers, Vector]:
        """Find the points of the surface that are closest to other points.

        Parameters
        ----------
        x : (k, gdim) array
            The points [m].

        Returns
        -------
        facet, weights : (k,) integer array, (k, gdim) array
            The facet that each closest point is on, and its barycentric coordinates there.
        """
        blocks = [self._closest(part)[:2] for part in _blocks(x)]
        point, facet = (np.concatenate(column) for column in zip(*blocks, strict=True))
        return facet, _barycentric(self._corners[facet], point)

    def gap_along(self, x: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """Find how far points can go along a direction until they meet the surface.

        Of the facets that face the direction, the nearest one ahead counts for a point outside,
        the nearest one behind for a point inside: it has to go back. Where there is none, the
        plane across the way to the closest point takes the surface's place. The result is at most
        twice the distance to the surface, also where the direction grazes or leaves it.

        Parameters
        ----------
        x : (k, gdim) array
            The points [m].
        direction : (k, gdim) array
            Unit vectors.

        Returns
        -------
        gap, signed : (k,) arrays
            Along the direction, and `Distance.signed` [m]; both negative inside.
        """
        distance = self.distance(x)
        met = [self._meet(*part) for part in zip(_blocks(x), _blocks(direction), strict=True)]
        ahead, behind = (np.concatenate(column) for column in zip(*met, strict=True))
        length = np.abs(distance.signed)
        cosine = -np.sum(direction * distance.normal, axis=1)
        plane = length / np.maximum(cosine, 1.0 / _OBLIQUE)
        along = np.where(distance.signed > 0.0, ahead, behind)
        along = np.where(np.isfinite(along), np.minimum(along, _OBLIQUE * length), plane)
        return np.sign(distance.signed) * along, distance.signed

    def _closest(self, x: Vector) -> tuple[Vector, Numbers, Numbers]:
        """Return the closest points, their facets, and the features of these they are on."""
        # as far as one facet is, others may be
        one = self._middles.query(x)[1]
        point = _closest_on(self._corners[one], self._normals[one], x)[0]
        limit = np.linalg.norm(point - x, axis=1) * (1.0 + 1e-9) + self._rounding

        def near(row: Numbers, low: Vector, high: Vector) -> Mask:
            away = np.maximum(np.maximum(low - x[row], x[row] - high), 0.0)
            close: Mask = np.einsum("ij,ij->i", away, away) <= limit[row] ** 2
            return close

        row, facet = self._tree.candidates(len(x), near)
        point, feature = _closest_on(self._corners[facet], self._normals[facet], x[row])
        length = np.linalg.norm(point - x[row], axis=1)
        order = np.lexsort((length, row))
        first = order[np.unique(row[order], return_index=True)[1]]
        return point[first], facet[first], feature[first]

    def _meet(self, x: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """Return how far ahead and behind facets meet the lines; infinite where none does."""
        with np.errstate(divide="ignore"):
            inverse = 1.0 / direction
        # lines along the faces of boxes
        margin = 1e-9 * self._tree.size

        def crossed(row: Numbers, low: Vector, high: Vector) -> Mask:
            with np.errstate(invalid="ignore"):
                one = (low - margin - x[row]) * inverse[row]
                other = (high + margin - x[row]) * inverse[row]
            enter = np.fmin(one, other).max(axis=1)
            leave = np.fmax(one, other).min(axis=1)
            meets: Mask = enter <= leave
            return meets

        row, facet = self._tree.candidates(len(x), crossed)
        corners, normal = self._corners[facet], self._normals[facet]
        cosine = -np.sum(direction[row] * normal, axis=1)
        height = np.sum((x[row] - corners[:, 0]) * normal, axis=1)
        along = height / np.where(cosine > _GRAZING, cosine, 1.0)
        weights = _barycentric(corners, x[row] + along[:, None] * direction[row])
        # NaN on facets without area
        hit = (cosine > _GRAZING) & (weights >= -_CRACK).all(axis=1)
        ahead, behind = np.full(len(x), np.inf), np.full(len(x), np.inf)
        for nearest, chosen in ((ahead, hit & (along >= 0.0)), (behind, hit & (along <= 0.0))):
            np.minimum.at(nearest, row[chosen], np.abs(along[chosen]))
        return ahead, behind


class _BoxTree:
    """A balanced binary tree of boxes around facets, level by level.

    Attributes
    ----------
    size : float
        The longest side of the box around all.
    """

    def __init__(self, corners: Vector) -> None:
        depth = max(0, int(np.ceil(np.log2(len(corners) / _LEAF))))
        leaf = -(-len(corners) // 2**depth)
        # some facets twice, so that all boxes hold equally many
        order = np.resize(np.arange(len(corners)), 2**depth * leaf)
        low, high = corners.min(axis=1), corners.max(axis=1)
        middle = 0.5 * (low + high)
        self._low, self._high = [], []
        for level in range(depth + 1):
            order = order.reshape(2**level, -1)
            self._low.append(low[order].min(axis=1))
            self._high.append(high[order].max(axis=1))
            if level < depth:
                axis = np.ptp(middle[order], axis=1).argmax(axis=1)
                place = middle[order, axis[:, None]]
                order = np.take_along_axis(order, place.argsort(axis=1), axis=1)
        self._leaves: Numbers = order.astype(np.int64)
        self.size = float((self._high[0] - self._low[0]).max())

    def candidates(
        self, number: int, wanted: Callable[[Numbers, Vector, Vector], Mask]
    ) -> tuple[Numbers, Numbers]:
        """Descend the tree with `number` queries.

        Parameters
        ----------
        number : int
            Of queries.
        wanted : callable
            (query (j,), low (j, gdim), high (j, gdim)) -> (j,) bool: whether a query wants what
            is in a box.

        Returns
        -------
        query, facet : integer arrays
            Pairs.
        """
        query, box = np.arange(number, dtype=np.int64), np.zeros(number, dtype=np.int64)
        for low, high in zip(self._low, self._high, strict=True):
            if low is not self._low[0]:
                query, box = np.repeat(query, 2), (2 * box[:, None] + [0, 1]).ravel()
            keep = wanted(query, low[box], high[box])
            query, box = query[keep], box[keep]
        return np.repeat(query, self._leaves.shape[1]), self._leaves[box].ravel()


def _blocks(rows: Vector) -> list[Vector]:
    return np.array_split(rows, -(-len(rows) // _BLOCK)) if len(rows) else [rows]


def _unit(vectors: Vector) -> Vector:
    """Return unit vectors; zero for zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: Vector = vectors / np.where(length > 0.0, length, 1.0)
    return units


def _edge_lengths(corners: Vector) -> Vector:
    lengths: Vector = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return lengths


def _angles(corners: Vector) -> Vector:
    """Return the angles of triangles at their corners, (m, 3)."""
    forth = _unit(np.roll(corners, -1, axis=1) - corners)
    back = _unit(np.roll(corners, 1, axis=1) - corners)
    angles: Vector = np.arccos(np.clip(np.sum(forth * back, axis=2), -1.0, 1.0))
    return angles


def _barycentric(corners: Vector, x: Vector) -> Vector:
    """Return the barycentric coordinates of points' projections, NaN on facets without area."""
    edges, offset = corners[:, 1:] - corners[:, :1], x - corners[:, 0]
    gram = edges @ edges.transpose(0, 2, 1)
    right = np.einsum("pej,pj->pe", edges, offset)
    with np.errstate(divide="ignore", invalid="ignore"):
        if corners.shape[2] == 2:
            rest = right / gram[:, 0]
        else:
            (a, b), c = gram[:, 0].T, gram[:, 1, 1]
            rest = np.column_stack(
                [c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]]
            )
            rest /= (a * c - b * b)[:, None]
    weights: Vector = np.column_stack([1.0 - rest.sum(axis=1), rest])
    return weights


def _closest_on(corners: Vector, normal: Vector, x: Vector) -> tuple[Vector, Numbers]:
    """Return the points of facets that are closest to x, and on which feature they are.

    Features are the corners, then (3D) the edges from each corner to the next, then the inside.
    """
    number, gdim = x.shape
    if gdim == 2:
        along = _along_edge(corners[:, 0], corners[:, 1], x)
        point = corners[:, 0] + along[:, None] * (corners[:, 1] - corners[:, 0])
        return point, np.select([along == 0.0, along == 1.0], [0, 1], 2).astype(np.int64)
    height = np.sum((x - corners[:, 0]) * normal, axis=1)
    point = x - height[:, None] * normal
    feature = np.full(number, 6, dtype=np.int64)
    outside = np.flatnonzero(~(_barycentric(corners, x) > _CORNER).all(axis=1))
    start = corners[outside]
    step = np.roll(start, -1, axis=1) - start
    along = _along_edge(start, start + step, x[outside, None, :])
    on_edges = start + along[:, :, None] * step
    edge = np.linalg.norm(on_edges - x[outside, None, :], axis=2).argmin(axis=1)
    row = np.arange(outside.size)
    point[outside] = on_edges[row, edge]
    along = along[row, edge]
    feature[outside] = np.select([along == 0.0, along == 1.0], [edge, (edge + 1) % 3], 3 + edge)
    return point, feature


def _along_edge(start: Vector, end: Vector, x: Vector) -> Vector:
    """Return where between 0 and 1 the closest point is; exactly 0 or 1 for the ends."""
    step = end - start
    square = np.sum(step * step, axis=-1)
    along = np.sum((x - start) * step, axis=-1) / np.where(square > 0.0, square, 1.0)
    along = np.where(along < _CORNER, 0.0, along)
    return np.where(along > 1.0 - _CORNER, 1.0, along)
