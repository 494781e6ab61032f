"""Oriented facets of one type: their planes, projections on planes, and shape functions.

A facet of degree 2 is cut at its nodes into pieces with straight edges: two segments, four
triangles or four bilinear quadrilaterals. Surfaces are projected on each other piece by piece; the
shape functions are those of the whole facet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.reference_cells import facet_type, lagrange_points, shape_values
from fenics_tfeti.fem.geometry.vectors import centres, cross
from fenics_tfeti.typing import Numbers, Vector

# For the number of nodes of a facet of degree 2, the corners of its pieces.
_PIECES = {
    3: ((0, 2), (2, 1)),
    6: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    9: ((0, 4, 8, 7), (4, 1, 5, 8), (8, 5, 2, 6), (7, 8, 6, 3)),
}


@dataclass(frozen=True)
class Facets:
    """A surface of segments (2D), triangles or quadrilaterals (3D), all of one type and degree.

    The nodes of a facet are its corners, oriented outwards, then for degree 2 the midpoints of the
    edges from each corner to the next and that of a quadrilateral. Seen along a segment, from
    corner 0 to 1, its normal points to the right; seen from the tip of its normal, a triangle or
    quadrilateral has its corners anticlockwise, one after the other around the facet.
    """

    points: Vector  # (n, gdim) [m]
    nodes: Numbers  # (f, t): rows of points
    contact: Numbers | None = None  # (n,): of surfaces of several contacts, that of each point
    depth: Vector | None = None  # (f,): how far behind each others may be [m]; by default any

    def __len__(self) -> int:
        return len(self.nodes)

    @property
    def number_of_corners(self) -> int:
        """Number of corners of a facet, and of each of its pieces."""
        return facet_type(self.points.shape[1] - 1, self.nodes.shape[1])[0].vertices

    @property
    def corners(self) -> Numbers:
        """The nodes (f, v) at the corners of the facets."""
        return self.nodes[:, : self.number_of_corners]

    @property
    def per_facet(self) -> int:
        """Number of pieces of each facet."""
        v, t = self.number_of_corners, self.nodes.shape[1]
        return 1 if v == t else len(_PIECES[t])

    @cached_property
    def pieces(self) -> Numbers:
        """The nodes (p, v) at the corners of the pieces, facet by facet."""
        v, t = self.number_of_corners, self.nodes.shape[1]
        return self.nodes if v == t else self.nodes[:, _PIECES[t]].reshape(-1, v)

    @cached_property
    def planes(self) -> Planes:
        """The planes of the pieces."""
        return Planes.of(self.coordinates())

    @cached_property
    def areas(self) -> Vector:
        """The areas (f,), sums over pieces in their planes [m^2 or m]."""
        areas: Vector = self.planes.area.reshape(len(self), self.per_facet).sum(axis=1)
        return areas

    def coordinates(self, chosen: Numbers | None = None) -> Vector:
        """Return the coordinates (k, v, gdim) of the corners of all or of some pieces (k,)."""
        pieces = self.pieces if chosen is None else self.pieces[chosen]
        # faster than an index
        return self.points.take(pieces, axis=0)

    def contact_of(self, nodes: Numbers) -> Numbers:
        """Return the contacts of nodes (k,)."""
        return np.zeros_like(nodes) if self.contact is None else self.contact[nodes]

    def apart(self, nodes: Numbers) -> Vector:
        """Return the places of nodes, `apart` by contacts if there are several."""
        x = self.points.take(nodes, axis=0)
        return x if self.contact is None else apart(x, self.contact[nodes])

    def simplices(self) -> Numbers:
        """Return segments or triangles, four around the centre of each quadrilateral.

        Facets of degree 2 are replaced by their pieces. The nodes are rows of `with_centres`.
        """
        pieces = self.pieces
        if self.number_of_corners < 4:
            return pieces
        centre = len(self.points) + np.arange(len(pieces))
        ends = zip(pieces.T, np.roll(pieces, -1, axis=1).T, strict=True)
        return np.concatenate([np.column_stack([*edge, centre]) for edge in ends])

    def with_centres(self, values: Vector) -> Vector:
        """Return values at nodes, followed by those at the centres of quadrilaterals."""
        if self.number_of_corners < 4:
            return values
        return np.concatenate([values, values[self.pieces].mean(axis=1)])

    def in_facet(self, piece: Numbers, xi: Vector) -> Vector:
        """Return the reference coordinates in facets (k, q, d) of those in their pieces (k,)."""
        per_facet, t = self.per_facet, self.nodes.shape[1]
        if per_facet == 1:
            return xi
        cell, degree = facet_type(xi.shape[-1], t)
        nodes = lagrange_points(cell.name, degree)[list(cell.around(degree))]
        nodes = nodes if cell.is_simplex else 2.0 * nodes - 1.0
        corners = nodes[np.array(_PIECES[t])]
        return np.matmul(shape_functions(xi, cell.vertices), corners[piece % per_facet])


def apart(x: Vector, contact: Numbers) -> Vector:
    """Return places (..., gdim) with one more axis, which keeps contacts apart in trees."""
    return np.concatenate([x, 1e30 * contact[..., None]], axis=-1)


@dataclass(frozen=True)
class Planes:
    """The auxiliary plane of each facet (in 2D the line of the segment).

    Seen from the tip of the normal, the corners in the plane are anticlockwise; in 2D the first
    axis points from corner 0 to corner 1.
    """

    origin: Vector  # (f, gdim): mean of the corners [m]
    axes: Vector  # (f, gdim, gdim): unit vectors in rows, gdim - 1 in the plane, then the normal
    area: Vector  # (f,): area of the facet's projection on the plane [m^2 or m]
    diameter: Vector  # (f,): largest distance of two corners [m]

    @staticmethod
    def of(x: Vector) -> Planes:
        """Find the planes of facets with the corners x (f, v, gdim)."""
        lines = (x[:, i] - x[:, j] for i in range(x.shape[1]) for j in range(i))
        diameter = np.sqrt(reduce(np.maximum, (np.einsum("fd,fd->f", u, u) for u in lines)))
        normal, edge = facet_normals(x), x[:, 1] - x[:, 0]
        area = np.linalg.norm(normal, axis=1)
        normal /= area[:, None]
        first = edge - np.einsum("fd,fd->f", edge, normal)[:, None] * normal
        first /= np.linalg.norm(first, axis=1)[:, None]
        axes = [first, normal] if x.shape[2] == 2 else [first, cross(normal, first), normal]
        return Planes(centres(x), np.stack(axes, axis=1), area, diameter)

    def chosen(self, rows: Numbers) -> Planes:
        """Return some of the planes."""
        return Planes(self.origin[rows], self.axes[rows], self.area[rows], self.diameter[rows])

    @property
    def normal(self) -> Vector:
        """Unit normals (f, gdim)."""
        return self.axes[:, -1]

    def project(self, facet: Numbers, x: Vector) -> Vector:
        """Return x (k, v, gdim) in the frames of some facets (k,): plane axes, then the height."""
        offset = [x[..., i].T - self.origin[:, i].take(facet) for i in range(x.shape[2])]
        parts = [
            sum(part * axis[:, i].take(facet) for i, part in enumerate(offset))
            for axis in np.moveaxis(self.axes, 1, 0)
        ]
        return np.stack([part.T for part in parts], axis=-1)


def shape_functions(xi: Vector, t: int) -> Vector:
    """Return the shape functions (..., t) of segments, triangles or quadrilaterals with t nodes.

    The reference coordinates (..., gdim - 1) are in [0, 1] on segments and triangles, in [-1, 1] on
    quadrilaterals. The nodes are the corners for degree 1, all nodes of `Facets` for degree 2.
    """
    dim = xi.shape[-1]
    cell, degree = facet_type(dim, t)
    places = (xi if cell.is_simplex else 0.5 * (1.0 + xi)).reshape(-1, dim)
    values = shape_values(cell.name, degree, places)
    return values[:, cell.around(degree)].reshape(*xi.shape[:-1], t)


def corner_functions(xi: Vector, t: int) -> Vector:
    """Return the shape functions (..., v) of degree 1 at the corners of facets with t nodes."""
    return shape_functions(xi, facet_type(xi.shape[-1], t)[0].vertices)


def reference_coordinates(corners: Vector, x: Vector) -> Vector:
    """Return the reference coordinates (k, q, gdim - 1) of points in or near facets of a plane.

    The corners (k, v, gdim - 1) and points (k, q, gdim - 1) are coordinates in the plane [m].
    """
    v = corners.shape[1]
    if v == 4:
        return _bilinear_coordinates(corners, x)
    offset = x - corners[:, :1]
    edges = corners[:, 1:] - corners[:, :1]
    if v == 2:
        return offset / edges
    (ux, uy), (wx, wy) = edges[:, 0].T[..., None], edges[:, 1].T[..., None]
    dx, dy = offset[..., 0], offset[..., 1]
    det = ux * wy - uy * wx
    return np.stack([dx * wy - dy * wx, ux * dy - uy * dx], axis=-1) / det[..., None]


def _bilinear_coordinates(corners: Vector, x: Vector) -> Vector:
    """Invert the bilinear map of convex quadrilaterals, in closed form."""
    # x = a + b r + c s + d r s; the cross product with c + d r leaves a quadratic equation for r
    signs = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]])
    a, b, c, d = np.einsum("ai,kij->akj", 0.25 * signs, corners)[:, :, :, None]
    (bx, by), (cx, cy), (dx, dy) = (np.moveaxis(part, 1, 0) for part in (b, c, d))
    qx, qy = x[..., 0] - a[:, 0], x[..., 1] - a[:, 1]
    square, constant = bx * dy - by * dx, qx * cy - qy * cx
    linear = bx * cy - by * cx - (qx * dy - qy * dx)
    # the root of the discriminant is the determinant of the map at the point
    root = np.sqrt(np.maximum(linear * linear + 4.0 * square * constant, 0.0))
    r = 2.0 * constant / (linear + np.copysign(root, linear))
    ux, uy = cx + dx * r, cy + dy * r
    s = ((qx - bx * r) * ux + (qy - by * r) * uy) / (ux * ux + uy * uy)
    return np.stack([r, s], axis=-1)
