"""The smallest facet around the covered part of each slave facet."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from fenics_tfeti.fem.geometry.facets import corner_functions
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Numbers, Vector

# power of the shape functions with which the weighted mean of points is close to those where they
# are largest
_POWER = 8
# a triangle does not surround a part of which one of its corners has a smaller share
_LEAST_SHARE = 0.02


def rim_functions(xi: Vector, facet: Numbers, ones: Vector) -> Vector:
    """Return T (c, v, v): the shape functions N_i at the corners j of the smallest facets.

    The covered parts of c facets consist of cells with corners xi (k, gdim, gdim - 1), reference
    coordinates in the `facet` (k,), ascending; `ones` (c, v) are the integrals of N_i. T is the
    unit matrix where all of a facet is covered. The smallest quadrilateral is an interval of each
    reference coordinate; the smallest segment or triangle has edges parallel to those of the facet.
    Such a triangle is much larger than a part that crosses the facet obliquely: where they surround
    the part, its corners are the points of the part at which the N_i are largest.
    """
    (c, v), first = ones.shape, np.searchsorted(facet, np.arange(len(ones) + 1))
    values = xi if v == 4 else corner_functions(xi, v)
    if not c:
        return np.zeros((0, v, v))
    low = np.minimum.reduceat(values.min(axis=1), first[:-1])
    if v == 4:
        high = np.maximum.reduceat(values.max(axis=1), first[:-1])
        low, high = _on_edges(low + 1.0) - 1.0, 1.0 - _on_edges(1.0 - high)
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = np.where(signs < 0, low[:, None], high[:, None])
        # exact at the corners of the facet
        bilinear: Vector = 0.25 * np.prod(1.0 + signs[:, None] * corners[:, None], axis=-1)
        return bilinear
    low = _on_edges(low)
    T: Vector = low[:, :, None] + (1.0 - low.sum(axis=1))[:, None, None] * np.eye(v)
    if v == 3:
        # the area of each cell, relative to the facet
        area = np.add.reduceat(np.abs(np.linalg.det(values)), first[:-1])
        for k in np.flatnonzero(area < 1.0 - RELATIVE_ROUNDING):
            points = values[first[k] : first[k + 1]].reshape(-1, 3)
            try:
                corners = _farthest_points(points)
                shares = np.linalg.solve(corners, ones[k] / ones[k].sum())
            except (QhullError, np.linalg.LinAlgError):
                # a line but for rounding
                continue
            if shares.min() > _LEAST_SHARE:
                T[k] = corners
    return T


def _on_edges(distance: Vector) -> Vector:
    """Set distances from edges to zero that are rounding."""
    return np.where(distance < RELATIVE_ROUNDING, 0.0, distance)


def _farthest_points(values: Vector) -> Vector:
    """Return the shape functions (3, 3), in columns, at the point where each of them is largest.

    The values (p, 3) are those at points of a part of a triangle. The point is a mean over the
    corners of the part's convex hull: the middle of an edge along which the function is constant.
    """
    hull = values[ConvexHull(values[:, 1:]).vertices]
    weights = (np.maximum(hull, 0.0) / hull.max(axis=0)) ** _POWER
    return (hull.T @ weights) / weights.sum(axis=0)
