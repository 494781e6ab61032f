"""Facets of a mesh with their nodes one after the other around them, oriented outwards."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.faceted import facet_normals
from fenics_tfeti.fem.reference_cells import ReferenceCell
from fenics_tfeti.fem.topology import cell_facets, cell_type, cell_vertices
from fenics_tfeti.typing import Indices, Vector


def owned_facets(domain: Mesh, facet_tags: Any, tag: int) -> Indices:
    """Return the facets (f,) with a tag that this rank owns, ascending."""
    facets = facet_tags.find(tag)
    owned = domain.topology.index_map(domain.topology.dim - 1).size_local
    return np.sort(facets[facets < owned])


def oriented_facets(space: FunctionSpace, facets: Indices) -> Indices:
    """Return the nodes (f, t) of facets on the boundary that this rank owns, oriented outwards.

    They are local nodes of the space, of degree 1 or 2, in the order of `Facets`.
    """
    domain = space.mesh
    dim, cell = domain.topology.dim, cell_type(domain)
    domain.topology.create_connectivity(dim - 1, dim)
    cells_of_facets = domain.topology.connectivity(dim - 1, dim)
    cells = np.asarray(cells_of_facets.array)[np.asarray(cells_of_facets.offsets)[facets]]
    numbers = np.argmax(cell_facets(domain)[cells] == facets[:, None], axis=1)
    degree = _compat.element_facts(space)[1]
    columns = np.array(cell.facet_nodes(degree))
    nodes: Indices = _compat.cell_dofs(space)[cells[:, None], columns[numbers]]

    x = domain.geometry.x[:, :dim]
    rows = cell_vertices(domain)[cells]
    corners = np.array(cell.facet_nodes(1))[numbers]
    corner_points = x[np.take_along_axis(rows, corners, axis=1)]
    outward = corner_points.mean(axis=1) - x[rows].mean(axis=1)
    normal = corner_normals(corner_points).sum(axis=1)
    inverted = np.sum(normal * outward, axis=1) < 0.0
    reflected = nodes[:, _reflection(cell.facet, nodes.shape[1])]
    return np.where(inverted[:, None], reflected, nodes)


def _reflection(facet: ReferenceCell, nodes: int) -> list[int]:
    """Return the order of a facet's nodes that reverses its orientation."""
    v = facet.vertices
    if v == 2:
        return [1, 0, 2][:nodes]
    corners = [0, *range(v - 1, 0, -1)]
    return [*corners, *range(2 * v - 1, v - 1, -1), 2 * v][:nodes]


def tangential_part(vectors: Vector, normal: Vector) -> Vector:
    """Return vectors (k, gdim) less their components along unit normals (k, gdim)."""
    tangential: Vector = vectors - np.sum(vectors * normal, axis=1)[:, None] * normal
    return tangential


def corner_normals(corners: Vector) -> Vector:
    """Return the integrals over facets of the normal times the shape function of each corner.

    The corners (m, v, gdim) of segments, triangles or bilinear quadrilaterals are one after the
    other around each. The results (m, v, gdim) [m^2 or m] are exact also for warped quadrilaterals:
    the cross product of their tangents is linear.
    """
    v = corners.shape[1]
    if v < 4:
        return np.repeat(facet_normals(corners)[:, None, :] / v, v, axis=1)
    # in the order of the corners: along the edges from 0 to 1 and from 0 to 3, and opposite ones
    u = corners[:, [1, 1, 2, 2]] - corners[:, [0, 0, 3, 3]]
    w = corners[:, [3, 2, 2, 3]] - corners[:, [0, 1, 1, 0]]
    # mass matrix of the unit square
    mass = np.array([[4, 2, 1, 2], [2, 4, 2, 1], [1, 2, 4, 2], [2, 1, 2, 4]]) / 36.0
    weighted: Vector = np.einsum("ij,mjk->mik", mass, np.cross(u, w))
    return weighted
