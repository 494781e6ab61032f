"""Facets of a mesh with their nodes one after the other around them, oriented outwards."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.mortar.facets import centres, cross, facet_normals
from fenics_tfeti.fem.reference_cells import (
    ReferenceCell,
    facet_type,
    quadrature,
    shape_gradients,
    shape_values,
)
from fenics_tfeti.fem.topology import cell_type, cell_vertices, cells_of_facets, facet_corners
from fenics_tfeti.typing import Indices, Numbers, Vector


def owned_facets(domain: Mesh, facet_tags: Any, tag: int) -> Indices:
    """Return the facets (f,) with a tag that this rank owns, ascending."""
    facets = facet_tags.find(tag)
    owned = domain.topology.index_map(domain.topology.dim - 1).size_local
    return np.sort(facets[facets < owned])


def oriented_facets(space: FunctionSpace, facets: Indices) -> Indices:
    """Return the local nodes (f, t) of owned facets on the boundary, oriented as in `Facets`."""
    domain, degree = space.mesh, _compat.element_facts(space)[1]
    cells, numbers = cells_of_facets(domain, facets)
    columns = np.array(cell_type(domain).facet_nodes(degree))
    nodes: Indices = _compat.cell_dofs(space)[cells[:, None], columns[numbers]]
    return _outwards(domain, cells, numbers, nodes)


def oriented_corners(domain: Mesh, cells: Numbers, numbers: Numbers) -> Indices:
    """Return the rows (f, v) of ``geometry.x`` at the corners of facets of cells, as above."""
    return _outwards(domain, cells, numbers, facet_corners(domain, cells, numbers))


def _outwards(domain: Mesh, cells: Numbers | Indices, numbers: Numbers, nodes: Indices) -> Indices:
    """Return the nodes (f, t) of facets of cells, by their numbers in these, oriented outwards."""
    x = domain.geometry.x[:, : domain.geometry.dim]
    corners = x[facet_corners(domain, cells, numbers)]
    outward = centres(corners) - centres(x[cell_vertices(domain)[cells]])
    inverted = np.einsum("fd,fd->f", facet_normals(corners), outward) < 0.0
    reflected = nodes[:, _reflection(cell_type(domain).facet, nodes.shape[1])]
    return np.where(inverted[:, None], reflected, nodes)


def _reflection(facet: ReferenceCell, nodes: int) -> list[int]:
    """Return the order of a facet's nodes that reverses its orientation."""
    v = facet.vertices
    if v == 2:
        return [1, 0, 2][:nodes]
    corners = [0, *range(v - 1, 0, -1)]
    return [*corners, *range(2 * v - 1, v - 1, -1), 2 * v][:nodes]


def tangential_part(vectors: Vector, normal: Vector) -> Vector:
    """Return vectors (..., gdim) less their components along unit normals (..., gdim)."""
    return vectors - np.sum(vectors * normal, axis=-1, keepdims=True) * normal


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
