"""Facets of a mesh with their nodes one after the other around them, oriented outwards."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx.fem import FunctionSpace
from dolfinx.mesh import Mesh

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.geometry.reference_cells import (
    ReferenceCell,
)
from fenics_tfeti.fem.geometry.vectors import centres
from fenics_tfeti.fem.topology import (
    Tag,
    cell_type,
    cell_vertices,
    cells_of_facets,
    facet_corners,
    find_tagged,
)
from fenics_tfeti.typing import Indices, Numbers


def owned_facets(domain: Mesh, facet_tags: Any, tag: Tag) -> Indices:
    """Return the facets (f,) with a tag, or with any of several, that this rank owns, ascending."""
    facets = find_tagged(facet_tags, tag)
    return facets[facets < domain.topology.index_map(domain.topology.dim - 1).size_local]


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
