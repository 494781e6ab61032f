"""Normals of facets, and how far facets are from curved surfaces with given normals."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fenics_tfeti.fem.geometry.reference_cells import (
    facet_type,
    quadrature,
    shape_gradients,
    shape_values,
)
from fenics_tfeti.fem.geometry.vectors import cross
from fenics_tfeti.typing import Vector


def facet_normals(corners: Vector) -> Vector:
    """Return the integrals (f, gdim) of the unit normal over facets [m^2 or m].

    The corners are (f, v, gdim) [m], for the direction see `Facets`. The length of a normal is that
    of the segment or the area of the triangle; of a quadrilateral, by its diagonals, it is the area
    of its projection on the plane that is perpendicular to it.
    """
    if corners.shape[2] == 2:
        edge = corners[:, 1] - corners[:, 0]
        return np.column_stack([edge[:, 1], -edge[:, 0]])
    x = np.moveaxis(corners, 1, 0)
    u, w = (x[1] - x[0], x[2] - x[0]) if len(x) == 3 else (x[2] - x[0], x[3] - x[1])
    return 0.5 * cross(u, w)


def corner_normals(x: Vector, weight: Vector | None = None) -> Vector:
    """Return the integrals over facets of the normal times the shape function of each corner.

    The nodes x (m, t, gdim) of facets of degree 1 or 2 are in the order of `Facets`, the shape
    functions are of degree 1, the weight (m, v) is linear between the corners. The results (m, v,
    gdim) [m^2 or m] are exact also for warped or curved facets: the cross product of their tangents
    is a polynomial.
    """
    t, dim = x.shape[1], x.shape[2] - 1
    if t == dim + 1 and weight is None:
        return np.repeat(facet_normals(x)[:, None, :] / t, t, axis=1)
    cell, degree = facet_type(dim, t)
    xi, factors = quadrature(cell.name, 2 * degree + 1)
    functions = shape_values(cell.name, 1, xi)[:, cell.around(1)]
    derivatives = shape_gradients(cell.name, degree, xi)[:, :, cell.around(degree)]
    # relative to a corner: normals along an axis have zeros, and rows fewer entries
    tangents = np.tensordot(derivatives, x - x[:, :1], (2, 1))
    if dim == 1:
        normal = np.stack([tangents[0, ..., 1], -tangents[0, ..., 0]], axis=2)
    else:
        normal = cross(*tangents)
    if weight is not None:
        normal *= (functions @ weight.T)[:, :, None]
    integrals: Vector = np.tensordot(factors[:, None] * functions, normal, (0, 0))
    return integrals.transpose(1, 0, 2)


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
