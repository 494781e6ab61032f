"""Oriented surfaces of segments or triangles: signed distances, and gaps along lines.

Nothing here uses dolfinx or communicates. Closest points and intersections are exact for facets of
any shapes and sizes: a tree of boxes selects the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.vectors import centres, edge_lengths, unit
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, ON_CORNER, RELATIVE_ROUNDING
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Distance:
    """Signed distances of points to a surface.

    The normal is the unit gradient of the signed distance: from the closest point to a point
    outside, and from a point inside to the closest one. On the surface it is its outward normal: at
    an edge the mean of the adjacent facets' normals, at a vertex their mean weighted with the
    facets' angles.
    """

    signed: Vector  # (k,), negative inside the body [m]
    normal: Vector  # (k, gdim)


class FacetedSurface:
    """A surface of segments (2D) or triangles (3D), open or closed, oriented as `facet_normals`."""

    def __init__(self, points: Vector, facets: Numbers) -> None:
        self._corners = points[facets]
        areas = facet_normals(self._corners)
        self._normals = unit(areas)
        self._centres = cKDTree(centres(self._corners))
        self._tree = BoxTree(self._corners)
        self._rounding = COORDINATE_ROUNDING * float(np.abs(points).max(initial=0.0))
        self._describe_features(facets)

    @staticmethod
    def of(facets: Facets) -> FacetedSurface:
        """Return the surface of segments or triangles that facets are divided into."""
        return FacetedSurface(facets.with_centres(facets.points), facets.simplices())

    def _describe_features(self, facets: Numbers) -> None:
        """Describe the features of each facet: corners, edges (3D) and the interior.

        Each has a normal, half the size of the largest facet there, and is on the border of the
        surface or not. The angle-weighted normals at vertices are those whose sign tells inside
        from outside (Baerentzen and Aanaes 2005).
        """
        m, gdim = facets.shape
        sizes = edge_lengths(self._corners).max(axis=1)
        if gdim == 2:
            weights, keys = np.ones((m, 2)), facets
            border = np.bincount(facets.ravel())[facets] == 1
        else:
            ends = np.sort(np.stack([facets, np.roll(facets, -1, axis=1)], axis=2), axis=2)
            number = int(facets.max()) + 1
            _, edges = np.unique(ends @ np.array([number, 1]), return_inverse=True)
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
        interior = np.zeros((m, 1), dtype=bool)
        self._feature_normals = np.concatenate(
            [unit(normals)[keys], self._normals[:, None, :]], axis=1
        )
        self._feature_border = np.hstack([border, interior])
        self._feature_half = np.hstack([halves[keys], 0.5 * sizes[:, None]])

    def distance(self, x: Vector) -> Distance:
        """Return the signed distances of points (k, gdim) to the surface.

        A point is inside if it is behind the closest point of the surface. Next to the border of an
        open surface, where the body's shape is not known, the surface is continued by its tangent
        plane over half a facet; points farther away are outside.
        """
        blocks = [self._closest(part) for part in _blocks(x)]
        point, facet, feature = (np.concatenate(column) for column in zip(*blocks, strict=True))
        normal = self._feature_normals[facet, feature]
        offset = x - point
        length = np.linalg.norm(offset, axis=1)
        height = np.sum(offset * normal, axis=1)
        tangential = np.linalg.norm(offset - height[:, None] * normal, axis=1)
        border = self._feature_border[facet, feature]
        continued = border & (tangential <= self._feature_half[facet, feature])
        signed = np.where(continued, height, np.where(border | (height >= 0.0), length, -length))
        distant = ~continued & (length > self._rounding)
        normal[distant] = offset[distant] / signed[distant, None]
        return Distance(signed, normal)

    def closest(self, x: Vector) -> tuple[Numbers, Vector]:
        """Return the facets (k,) closest to points, and barycentric coordinates (k, gdim) there."""
        blocks = [self._closest(part)[:2] for part in _blocks(x)]
        point, facet = (np.concatenate(column) for column in zip(*blocks, strict=True))
        return facet, _barycentric(self._corners[facet], point)

    def gap_along(self, x: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """Return the gaps (k,) along unit vectors, and `Distance.signed` [m]; both negative inside.

        For a point outside it is the distance along the direction to the nearest facet that faces
        the direction; for a point inside, the distance backwards, counted negative. Where the line
        meets no such facet, the surface is replaced by the plane through the closest point and
        perpendicular to `Distance.normal`. The result is at most twice the distance to the surface,
        so that lines of more than 60 degrees to the normal give no large gaps.
        """
        largest_ratio = 2.0
        distance = self.distance(x)
        intersections = [
            self._intersect(*part) for part in zip(_blocks(x), _blocks(direction), strict=True)
        ]
        forward, backward = (np.concatenate(column) for column in zip(*intersections, strict=True))
        length = np.abs(distance.signed)
        cosine = -np.sum(direction * distance.normal, axis=1)
        plane = length / np.maximum(cosine, 1.0 / largest_ratio)
        gap = np.where(distance.signed > 0.0, forward, backward)
        gap = np.where(np.isfinite(gap), np.minimum(gap, largest_ratio * length), plane)
        return np.sign(distance.signed) * gap, distance.signed

    def _closest(self, x: Vector) -> tuple[Vector, Numbers, Numbers]:
        """Return the closest points, their facets, and the features of the facets they are on."""
        # the distance to any one facet bounds the distance to the closest
        seed = self._centres.query(x)[1]
        point = _closest_on(self._corners[seed], self._normals[seed], x)[0]
        limit = np.linalg.norm(point - x, axis=1) * (1.0 + RELATIVE_ROUNDING) + self._rounding

        def near(row: Numbers, low: Vector, high: Vector) -> Mask:
            offset = np.maximum(np.maximum(low - x[row], x[row] - high), 0.0)
            return np.einsum("ij,ij->i", offset, offset) <= limit[row] ** 2

        row, facet = self._tree.candidates(len(x), near)
        point, feature = _closest_on(self._corners[facet], self._normals[facet], x[row])
        length = np.linalg.norm(point - x[row], axis=1)
        order = np.lexsort((length, row))
        first = order[np.unique(row[order], return_index=True)[1]]
        return point[first], facet[first], feature[first]

    def _intersect(self, x: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """Return the distances ahead and behind at which lines meet facets; infinite for none."""
        with np.errstate(divide="ignore"):
            inverse = 1.0 / direction
        # for lines along the sides of boxes
        margin = RELATIVE_ROUNDING * self._tree.size

        def crossed(row: Numbers, low: Vector, high: Vector) -> Mask:
            with np.errstate(invalid="ignore"):
                t_low = (low - margin - x[row]) * inverse[row]
                t_high = (high + margin - x[row]) * inverse[row]
            enter = np.fmin(t_low, t_high).max(axis=1)
            leave = np.fmax(t_low, t_high).min(axis=1)
            return enter <= leave

        row, facet = self._tree.candidates(len(x), crossed)
        corners, normal = self._corners[facet], self._normals[facet]
        cosine = -np.sum(direction[row] * normal, axis=1)
        height = np.sum((x[row] - corners[:, 0]) * normal, axis=1)
        faces = cosine > RELATIVE_ROUNDING
        distance = height / np.where(faces, cosine, 1.0)
        weights = _barycentric(corners, x[row] + distance[:, None] * direction[row])
        # up to rounding, so that no line passes between two facets; False on facets without area,
        # where the weights are NaN
        hit = faces & (weights >= -RELATIVE_ROUNDING).all(axis=1)
        forward, backward = np.full(len(x), np.inf), np.full(len(x), np.inf)
        for nearest, chosen in (
            (forward, hit & (distance >= 0.0)),
            (backward, hit & (distance <= 0.0)),
        ):
            np.minimum.at(nearest, row[chosen], np.abs(distance[chosen]))
        return forward, backward


def _blocks(rows: Vector) -> list[Vector]:
    """Split points into blocks, to bound the memory where many facets are equally far."""
    points_of_block = 2048
    return np.array_split(rows, -(-len(rows) // points_of_block)) if len(rows) else [rows]


def _angles(corners: Vector) -> Vector:
    """Return the angles of triangles at their corners, (m, 3)."""
    forward = unit(np.roll(corners, -1, axis=1) - corners)
    backward = unit(np.roll(corners, 1, axis=1) - corners)
    return np.arccos(np.clip(np.sum(forward * backward, axis=2), -1.0, 1.0))


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
    return np.column_stack([1.0 - rest.sum(axis=1), rest])


def _closest_on(corners: Vector, normal: Vector, x: Vector) -> tuple[Vector, Numbers]:
    """Return the points of facets that are closest to x, and the features they are on.

    The features are numbered: the corners, then (3D) the edge from each corner to the next, then
    the interior.
    """
    number, gdim = x.shape
    if gdim == 2:
        position = _edge_position(corners[:, 0], corners[:, 1], x)
        point = corners[:, 0] + position[:, None] * (corners[:, 1] - corners[:, 0])
        return point, np.select([position == 0.0, position == 1.0], [0, 1], 2).astype(np.int64)
    height = np.sum((x - corners[:, 0]) * normal, axis=1)
    point = x - height[:, None] * normal
    feature = np.full(number, 6, dtype=np.int64)
    outside = np.flatnonzero(~(_barycentric(corners, x) > ON_CORNER).all(axis=1))
    start = corners[outside]
    step = np.roll(start, -1, axis=1) - start
    position = _edge_position(start, start + step, x[outside, None, :])
    edge_points = start + position[:, :, None] * step
    edge = np.linalg.norm(edge_points - x[outside, None, :], axis=2).argmin(axis=1)
    row = np.arange(outside.size)
    point[outside] = edge_points[row, edge]
    position = position[row, edge]
    ends = [position == 0.0, position == 1.0]
    feature[outside] = np.select(ends, [edge, (edge + 1) % 3], 3 + edge)
    return point, feature


def _edge_position(start: Vector, end: Vector, x: Vector) -> Vector:
    """Return the position of the closest point of an edge, exactly 0 and 1 at its ends."""
    step = end - start
    square = np.sum(step * step, axis=-1)
    position = np.sum((x - start) * step, axis=-1) / np.where(square > 0.0, square, 1.0)
    position = np.where(position < ON_CORNER, 0.0, position)
    return np.where(position > 1.0 - ON_CORNER, 1.0, position)
