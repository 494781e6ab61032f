"""Checks of cells: volume, sign of the Jacobian, overlap with neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.messages import coordinate_order, format_mesh_point
from fenics_tfeti.fem.reference_cells import ReferenceCell
from fenics_tfeti.fem.tolerances import FLAT_CELL
from fenics_tfeti.fem.topology import cell_facets, cell_type, cell_vertices
from fenics_tfeti.parallel import concatenate_ranks

__all__ = ["CellGeometry", "check_overlaps", "check_shapes"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CellGeometry:
    """The cells that this rank owns.

    Attributes
    ----------
    type : ReferenceCell
        The cells' type.
    nodes : (m, v) integer array
        Rows of ``geometry.x`` at the vertices.
    corners : (m, v, gdim) array
        Coordinates [m].
    midpoint : (m, gdim) array
        Means of the corners [m].
    size : (m,) array
        Twice the largest distance of a corner from the midpoint [m].
    body : (m,) integer array
        The body of each.
    """

    type: ReferenceCell
    nodes: NDArray[np.int32]
    corners: Vector
    midpoint: Vector
    size: Vector
    body: Numbers

    @staticmethod
    def of(domain: Mesh, body: Numbers) -> CellGeometry:
        """Compute it for a mesh, given the body of each owned cell."""
        nodes = cell_vertices(domain)[: body.size]
        corners = domain.geometry.x[:, : domain.geometry.dim][nodes]
        # by corner: several times faster than reductions over short axes
        vertices = range(corners.shape[1])
        midpoint = np.zeros((body.size, corners.shape[2]))
        for v in vertices:
            midpoint += corners[:, v]
        midpoint /= max(len(vertices), 1)
        square = np.zeros(body.size)
        for v in vertices:
            spoke = corners[:, v] - midpoint
            np.maximum(square, np.einsum("ij,ij->i", spoke, spoke), out=square)
        size = 2.0 * np.sqrt(square)
        return CellGeometry(cell_type(domain), nodes, corners, midpoint, size, body)

    def shortest_edges(self, cells: Numbers) -> Vector:
        """Return the length of some cells' shortest edges whose length is not zero."""
        size, corners = self.size[cells], self.corners[cells]
        shortest = size.copy()
        for a, b in self.type.edges:
            length = np.linalg.norm(corners[:, a] - corners[:, b], axis=1)
            np.minimum(shortest, length, out=shortest, where=length > FLAT_CELL * size)
        return shortest


# -- single cells ------------------------------------------------------------------------------


def check_shapes(domain: Mesh, bodies: Bodies, cells: CellGeometry) -> None:
    """Check the determinants of the Jacobians, whose sign dolfinx ignores. Collective.

    Raises
    ------
    InputError
        Cells in which the determinant changes its sign, straight or curved, cells without volume.
    """
    at_corners, at_midpoint = _determinants(cells)
    dim = cells.midpoint.shape[1]
    scale = FLAT_CELL * cells.size**dim
    _raise_for_cells(
        domain,
        bodies,
        cells,
        (at_corners.min(axis=1) < -scale) & (at_corners.max(axis=1) > scale),
        "twisted cells, in which the determinant of the Jacobian changes its sign",
        "Check that their vertices are in the order of dolfinx (those of a quadrilateral row by "
        "row, not around it); otherwise mesh there again",
    )
    what = "volume (det J / size^3" if dim == 3 else "area (det J / size^2"
    _raise_for_cells(
        domain,
        bodies,
        cells,
        np.abs(at_midpoint) <= scale,
        f"cells without {what} is below {FLAT_CELL:g})",
        "Mesh there again, or remove these cells",
    )
    if _compat.geometry_degree(domain) == 2:
        lowest, highest = _range_in_curved_cells(domain, cells)
        _raise_for_cells(
            domain,
            bodies,
            cells,
            (lowest < scale) & (highest > -scale),
            "curved cells that are folded: the determinant of the Jacobian changes its sign",
            "Mesh there finer, or let Gmsh mend them (optimize with 'HighOrderElastic')",
        )


def _range_in_curved_cells(domain: Mesh, cells: CellGeometry) -> tuple[Vector, Vector]:
    """Return the smallest and the largest det J (m,) at the nodes of cells of degree 2."""
    at_once = 2**14  # to bound the memory
    x, nodes = domain.geometry.x[:, : domain.geometry.dim], _compat.geometry_cells(domain)
    gradients = _compat.gradients_at_nodes(cells.type.name)
    found = [np.zeros((0, nodes.shape[1]))]
    for first in range(0, cells.body.size, at_once):
        own = x[nodes[first : min(first + at_once, cells.body.size)]]
        found.append(_determinant([np.matmul(along, own) for along in gradients]))
    values = np.concatenate(found)
    return values.min(axis=1), values.max(axis=1)


def _determinants(cells: CellGeometry) -> tuple[Vector, Vector]:
    """Return det J (m, corners) at the corners and (m,) at the midpoint."""
    x, dim = cells.corners, cells.midpoint.shape[1]
    if cells.type.is_simplex:
        constant = _determinant([x[:, k] - x[:, 0] for k in range(1, dim + 1)])
        return constant[:, None], constant
    # in tensor order, corners that differ in bit d of their number are the ends of an edge along d
    grid = x.reshape(len(x), *(2,) * dim, dim)
    edges = [np.diff(grid, axis=dim - d) for d in range(dim)]
    number = 2 ** (dim - 1)
    means = [np.einsum("ijk->ik", e.reshape(len(x), number, dim)) / number for e in edges]
    return _determinant(edges).reshape(len(x), 2**dim), _determinant(means)


def _determinant(columns: Sequence[Vector]) -> Vector:
    """Return the determinants (...) of matrices given by their columns (..., dim)."""
    a, b = columns[0], columns[1]
    plane: Vector = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    if len(columns) == 2:
        return plane
    c = columns[2]
    volume: Vector = (
        plane * c[..., 2]
        + (a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]) * c[..., 0]
        + (a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]) * c[..., 1]
    )
    return volume


def _raise_for_cells(
    domain: Mesh, bodies: Bodies, cells: CellGeometry, wrong: Mask, what: str, remedy: str
) -> None:
    """Raise on all ranks if any has wrong cells, naming the first by its coordinates."""
    points = concatenate_ranks(domain.comm, cells.midpoint[wrong])
    of = concatenate_ranks(domain.comm, cells.body[wrong])
    if not len(points):
        return
    first = coordinate_order(points)[0]
    total = domain.comm.allreduce(cells.body.size)
    where = "around" if len(points) == 1 else "the first around"
    raise InputError(
        f"the mesh has {what}: {len(points)} of {total} cells, {where} "
        f"{format_mesh_point(domain, points[first])} in {bodies.names[of[first]]}. {remedy}"
    )


# -- neighbours --------------------------------------------------------------------------------


def check_overlaps(domain: Mesh, bodies: Bodies, cells: CellGeometry) -> None:
    """Check that the two cells of a facet are on different sides of it. Collective.

    Raises
    ------
    InputError
        Cells on the same side of a common facet, such as a cell turned inside out.
    """
    facets = cell_facets(domain)[: cells.body.size]
    side = _sides_of_simplices(cells) if cells.type.is_simplex else _sides_by_place(facets, cells)
    number = int(facets.max(initial=-1)) + 1
    above, below = (np.bincount(facets[side == s], minlength=number) for s in (1.0, -1.0))
    folded = np.count_nonzero(((above > 1) | (below > 1))[facets], axis=1)
    # a cell turned inside out has several such facets, each of its neighbours one
    most = domain.comm.allreduce(int(folded.max(initial=0)), MPI.MAX)
    _raise_for_cells(
        domain,
        bodies,
        cells,
        (folded > 0) & (folded == most),
        "cells that overlap their neighbours, on the same side of a common facet",
        "A vertex was moved through the opposite side: mesh there again",
    )


def _sides_of_simplices(cells: CellGeometry) -> Vector:
    """Return for each facet of each simplex on which side of it the simplex is: -1, 0, 1.

    A positive simplex orients its facets, the k-th by (-1)^k and the order of its vertices; cells
    on the two sides of a facet give it opposite orientations.
    """
    volume = np.sign(_determinants(cells)[1])
    side = np.empty(cells.nodes.shape)
    for k, facet in enumerate(cells.type.facets):
        pairs = combinations(facet, 2)
        odd = np.bitwise_xor.reduce([cells.nodes[:, a] > cells.nodes[:, b] for a, b in pairs])
        side[:, k] = np.where(odd, -volume, volume) * (-1) ** k
    return side


def _sides_by_place(facets: NDArray[np.int32], cells: CellGeometry) -> Vector:
    """Return for each facet of each cell on which side of it the cell's midpoint is: -1, 0, 1."""
    local = np.array(cells.type.facets)
    count, per_cell = facets.shape
    # the facet's plane is that in the last of its cells
    seen = np.zeros(int(facets.max(initial=-1)) + 1, dtype=np.int64)
    seen[facets.ravel()] = np.arange(facets.size)
    cell, position = np.divmod(seen, per_cell)
    x = cells.corners[cell[:, None], local[position]]
    if x.shape[2] == 2:
        tangent = x[:, 1] - x[:, 0]
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    else:
        # perpendicular to both diagonals
        normal = np.cross(x[:, 3] - x[:, 0], x[:, 2] - x[:, 1])
    height = np.empty((count, per_cell))
    centre = x.mean(axis=1)
    for k in range(per_cell):
        of = facets[:, k]
        height[:, k] = np.einsum("ij,ij->i", cells.midpoint - centre[of], normal[of])
    limit = FLAT_CELL * cells.size[:, None] ** x.shape[2]
    return np.where(np.abs(height) > limit, np.sign(height), 0.0)
