"""Reference cells: vertices, edges and facets, and their order in dolfinx.

Vertices, edges and facets are numbered as in basix and dolfinx; the vertices of quadrilaterals and
hexahedra in tensor-product order, vertex x + 2 y + 4 z at the point (x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import basix

from fenics_tfeti.typing import Vector

Vertices = tuple[int, ...]


@dataclass(frozen=True)
class ReferenceCell:
    """A cell type: its vertices and, for degree 2, its other nodes.

    The nodes of degree 2 are the vertices, the midpoints of the edges, those of the facets that are
    quadrilaterals, and the midpoint of a quadrilateral or hexahedron, in this order.
    """

    name: str  # in dolfinx and UFL
    dim: int
    vertices: int
    edges: tuple[tuple[int, int], ...]  # vertices of each, in dolfinx's numbering of edges
    facets: tuple[Vertices, ...]  # vertices of each, in dolfinx's numbering of facets
    # The cells into which one block of a grid is cut, by the vertices of the block in tensor-
    # product order. Simplices all share the diagonal from the lowest to the highest vertex:
    # opposite sides of the block are cut alike, so that adjacent grids match.
    grid_cut: tuple[Vertices, ...]

    @property
    def is_simplex(self) -> bool:
        """True for intervals, triangles and tetrahedra."""
        return self.vertices == self.dim + 1

    @property
    def facet(self) -> ReferenceCell:
        """The cell type of the facets; not for intervals."""
        return reference_cell(_FACET_NAMES[len(self.facets[0])])

    def nodes(self, degree: int) -> int:
        """Return the number of nodes of degree 1 or 2."""
        return len(lagrange_points(self.name, degree))

    @cache  # noqa: B019 - cell types are few, and kept
    def facet_nodes(self, degree: int) -> tuple[Vertices, ...]:
        """Return the nodes of each facet for degree 1 or 2, as numbers of the cell's nodes.

        First come the corners, one after the other around the facet, then the midpoints of the
        edges from each to the next, then that of a quadrilateral.
        """
        order = self.facet.cycle
        cycles = tuple(tuple(facet[k] for k in order) for facet in self.facets)
        if degree == 1:
            return cycles
        return tuple(self._with_midpoints(cycle, k) for k, cycle in enumerate(cycles))

    @property
    def midpoints(self) -> tuple[Vertices, ...]:
        """The vertices around each node of degree 2 that is not a vertex; it is in their middle."""
        if self.is_simplex:
            return self.edges
        faces = self.facets if self.dim == 3 else ()
        return (*self.edges, *faces, tuple(range(self.vertices)))

    @property
    def cycle(self) -> Vertices:
        """The vertices of a cell of two dimensions or less one after the other around it."""
        return (0, 1, 3, 2) if self.name == "quadrilateral" else tuple(range(self.vertices))

    def around(self, degree: int) -> Vertices:
        """Return the nodes of a cell of two dimensions or less, in the order of `facet_nodes`."""
        return self.cycle if degree == 1 else self._with_midpoints(self.cycle, 0)

    def _with_midpoints(self, cycle: Vertices, number: int) -> Vertices:
        """Return the nodes of degree 2 of a face of a number in the order of `facet_nodes`."""
        middle = {edge: self.vertices + k for k, edge in enumerate(self.edges)}
        ends = [cycle] if len(cycle) == 2 else zip(cycle, cycle[1:] + cycle[:1], strict=True)
        centre = [self.vertices + len(self.edges) + number] if len(cycle) == 4 else []
        return (*cycle, *(middle[min(pair), max(pair)] for pair in ends), *centre)


MESH_CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
"""Names of the cell types that a mesh can have."""

# by their numbers of vertices
_FACET_NAMES = {2: "interval", 3: "triangle", 4: "quadrilateral"}
_GRID_CUTS = {
    "triangle": ((0, 1, 3), (0, 2, 3)),
    "tetrahedron": (
        *((0, 1, 3, 7), (0, 1, 5, 7), (0, 4, 5, 7)),
        *((0, 2, 3, 7), (0, 4, 6, 7), (0, 2, 6, 7)),
    ),
}


@cache
def reference_cell(name: str) -> ReferenceCell:
    """Return the cell type with a name of dolfinx, with the vertices that basix has for it.

    >>> reference_cell("tetrahedron").facet.edges
    ((1, 2), (0, 2), (0, 1))
    """
    entities = basix.topology(getattr(basix.CellType, name))
    vertices = tuple(range(len(entities[0])))
    return ReferenceCell(
        name,
        dim=len(entities) - 1,
        vertices=len(vertices),
        edges=tuple((a, b) for a, b in entities[1]),
        facets=tuple(map(tuple, entities[-2])),
        grid_cut=_GRID_CUTS.get(name, (vertices,)),
    )


def facet_type(dim: int, nodes: int) -> tuple[ReferenceCell, int]:
    """Return the type and the degree of facets of a dimension with so many nodes."""
    name = "interval" if dim == 1 else "triangle" if nodes in (3, 6) else "quadrilateral"
    return reference_cell(name), 1 if nodes == reference_cell(name).vertices else 2


def quadrature(name: str, degree: int) -> tuple[Vector, Vector]:
    """Return points (q, dim) and weights on a cell, exact for polynomials of a degree.

    >>> quadrature("triangle", 2)[1].tolist()
    [0.16666666666666666, 0.16666666666666666, 0.16666666666666666]
    """
    points, weights = basix.make_quadrature(getattr(basix.CellType, name), degree)
    return np.asarray(points), np.asarray(weights)


def lagrange_points(name: str, degree: int) -> Vector:
    """Return the nodes (n, dim) of the Lagrange element of degree 1 or 2 on a cell."""
    return np.asarray(_lagrange_element(name, degree).points)


def shape_values(name: str, degree: int, points: Vector) -> Vector:
    """Return the values (k, n) of the n shape functions of degree 1 or 2 at k points."""
    element = _lagrange_element(name, degree)
    if not len(points):  # which basix 0.5 ends the process for
        return np.zeros((0, len(element.points)))
    return np.asarray(element.tabulate(0, points)[0, :, :, 0])


def shape_gradients(name: str, degree: int, points: Vector) -> Vector:
    """Return derivatives (axis, k, n) of the n shape functions of degree 1 or 2 at k points."""
    return np.asarray(_lagrange_element(name, degree).tabulate(1, points)[1:, :, :, 0])


@cache
def _lagrange_element(name: str, degree: int) -> Any:
    kind, family = getattr(basix.CellType, name), basix.ElementFamily.P
    return basix.create_element(family, kind, degree, basix.LagrangeVariant.gll_warped)
