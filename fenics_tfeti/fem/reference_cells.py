"""Reference cells: vertices, edges and facets, and their order in dolfinx and in VTK.

Vertices, edges and facets are numbered as in basix and dolfinx; the vertices of quadrilaterals and
hexahedra in tensor-product order, vertex x + 2 y + 4 z at the point (x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
    facet_name: str
    axes: Vertices  # neighbours of vertex 0, such that the edges to them form a right-handed system
    reflected: Vertices  # the vertices in an order that reverses the orientation
    vtk_type: int
    vtk_order: Vertices  # the vertices in the order of VTK, which is also that of Gmsh
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
        return reference_cell(self.facet_name)

    def nodes(self, degree: int) -> int:
        """Return the number of nodes of degree 1 or 2."""
        if degree == 1:
            return self.vertices
        return self.vertices * (self.vertices + 1) // 2 if self.is_simplex else 3**self.dim

    def facet_nodes(self, degree: int) -> tuple[Vertices, ...]:
        """Return the nodes of each facet for degree 1 or 2, as numbers of the cell's nodes.

        First come the corners, one after the other around the facet, then the midpoints of the
        edges from each to the next, then that of a quadrilateral.
        """
        return self._facet_nodes[degree - 1]

    @property
    def midpoints(self) -> tuple[Vertices, ...]:
        """The vertices around each node of degree 2 that is not a vertex; it is in their middle."""
        if self.is_simplex:
            return self.edges
        faces = self.facets if self.dim == 3 else ()
        return (*self.edges, *faces, tuple(range(self.vertices)))

    def pieces(self, degree: int) -> tuple[Vertices, ...]:
        """Return the cells of this type into which the nodes of degree 1 or 2 cut the cell."""
        return self._halved if degree == 2 else (tuple(range(self.vertices)),)

    @cached_property
    def _halved(self) -> tuple[Vertices, ...]:
        means = (*((vertex,) for vertex in range(self.vertices)), *self.midpoints)
        number = {frozenset(mean): node for node, mean in enumerate(means)}
        cut = _SIMPLEX_PIECES[self.dim] if self.is_simplex else _grid_pieces(self.dim)
        return tuple(tuple(number[frozenset(mean)] for mean in piece) for piece in cut)

    @cached_property
    def _facet_nodes(self) -> tuple[tuple[Vertices, ...], tuple[Vertices, ...]]:
        cycle_order = self.facet.vtk_order
        linear = tuple(tuple(facet[k] for k in cycle_order) for facet in self.facets)
        number = {edge: self.vertices + k for k, edge in enumerate(self.edges)}
        quadratic = []
        for k, cycle in enumerate(linear):
            ends = [cycle] if self.dim == 2 else zip(cycle, cycle[1:] + cycle[:1], strict=True)
            middles = [number[min(pair), max(pair)] for pair in ends]
            centre = [self.vertices + len(self.edges) + k] if len(cycle) == 4 else []
            quadratic.append((*cycle, *middles, *centre))
        return linear, tuple(quadratic)


# The pieces of simplices of degree 2, by the vertices whose mean each corner is.
_SIMPLEX_PIECES: dict[int, tuple[tuple[Vertices, ...], ...]] = {
    2: (
        ((0,), (0, 1), (0, 2)),
        ((0, 1), (1,), (1, 2)),
        ((0, 2), (1, 2), (2,)),
        ((0, 1), (1, 2), (0, 2)),
    ),
    3: (
        ((0,), (0, 1), (0, 2), (0, 3)),
        ((0, 1), (1,), (1, 2), (1, 3)),
        ((0, 2), (1, 2), (2,), (2, 3)),
        ((0, 3), (1, 3), (2, 3), (3,)),
        # the octahedron that is left, around its diagonal between the edges 02 and 13
        ((0, 2), (1, 3), (0, 1), (1, 2)),
        ((0, 2), (1, 3), (1, 2), (2, 3)),
        ((0, 2), (1, 3), (2, 3), (0, 3)),
        ((0, 2), (1, 3), (0, 3), (0, 1)),
    ),
}


def _grid_pieces(dim: int) -> list[list[Vertices]]:
    """Return the pieces of a quadrilateral or hexahedron of degree 2, as `_SIMPLEX_PIECES`."""
    corners = [[v >> axis & 1 for axis in range(dim)] for v in range(2**dim)]

    def vertices_around(first: list[int], second: list[int]) -> Vertices:
        # along each axis the side where both are, or both sides
        return tuple(
            v
            for v, corner in enumerate(corners)
            if all(a != b or c == a for a, b, c in zip(first, second, corner, strict=True))
        )

    return [[vertices_around(piece, corner) for corner in corners] for piece in corners]


def _from_basix(
    name: str, facet_name: str, vtk_type: int, grid_cut: tuple[Vertices, ...] = ()
) -> ReferenceCell:
    """Return a cell type with the vertices, edges and facets that basix has for it."""
    corners, *entities = basix.topology(getattr(basix.CellType, name))
    vertices, dim = range(len(corners)), len(entities)
    edges = tuple((a, b) for a, b in entities[0])
    tensor, swapped = len(vertices) == 2**dim > 2, (1, 2)  # a swap of the first two axes
    return ReferenceCell(
        name=name,
        dim=dim,
        vertices=len(vertices),
        edges=edges,
        facets=tuple(map(tuple, entities[dim - 2])) if dim > 1 else ((0,), (1,)),
        facet_name=facet_name,
        axes=tuple(sorted(b for a, b in edges if a == 0)),
        reflected=tuple(v ^ 3 if v % 4 in swapped else v for v in vertices) if dim > 1 else (1, 0),
        vtk_type=vtk_type,
        vtk_order=tuple(v ^ (v >> 1 & 1) for v in vertices) if tensor else tuple(vertices),
        grid_cut=grid_cut or (tuple(vertices),),
    )


_TRIANGLES = ((0, 1, 3), (0, 2, 3))
_TETRAHEDRA = (
    *((0, 1, 3, 7), (0, 1, 5, 7), (0, 4, 5, 7)),
    *((0, 2, 3, 7), (0, 4, 6, 7), (0, 2, 6, 7)),
)
_CELLS = {
    cell.name: cell
    for cell in (
        _from_basix("interval", "point", 3),
        _from_basix("triangle", "interval", 5, _TRIANGLES),
        _from_basix("quadrilateral", "interval", 9),
        _from_basix("tetrahedron", "triangle", 10, _TETRAHEDRA),
        _from_basix("hexahedron", "quadrilateral", 12),
    )
}

MESH_CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
"""Names of the cell types that a mesh can have."""


def reference_cell(name: str) -> ReferenceCell:
    """Return the cell type with a name of dolfinx.

    >>> reference_cell("tetrahedron").facet.edges
    ((1, 2), (0, 2), (0, 1))
    """
    return _CELLS[name]


def quadrature(name: str, degree: int) -> tuple[Vector, Vector]:
    """Return points (q, dim) and weights on a cell, exact for polynomials of a degree.

    >>> quadrature("triangle", 2)[1].tolist()
    [0.16666666666666666, 0.16666666666666666, 0.16666666666666666]
    """
    points, weights = basix.make_quadrature(getattr(basix.CellType, name), degree)
    return np.asarray(points), np.asarray(weights)
