"""Checks of cells: volume, sign of the Jacobian, overlap with neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.reference_cells import (
    ReferenceCell,
    lagrange_points,
    shape_gradients,
)
from fenics_tfeti.fem.gradients import determinants
from fenics_tfeti.fem.messages import coordinate_order, first_mesh_point
from fenics_tfeti.fem.tolerances import FLAT_CELL
from fenics_tfeti.fem.topology import cell_facets, cell_type
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively
from fenics_tfeti.typing import Indices, Mask, Numbers, Vector

# cells at once: what is computed of them stays in the cache
_CELLS = 2**12


@dataclass(frozen=True)
class CellGeometry:
    """The m cells of a mesh that this rank owns.

    Coordinates are by component, with the cells as the last axis: several times faster than
    operations over short last axes.
    """

    domain: Mesh
    bodies: Bodies
    type: ReferenceCell
    nodes: Indices  # (m, v) rows of ``geometry.x`` at the vertices
    x: Vector  # (gdim, n) coordinates of the nodes [m]
    midpoint: Vector  # (gdim, m) means of the corners [m]
    size: Vector  # twice the largest distance of a corner from the midpoint [m]
    # least and largest det J at nodes and midpoint, and that at the midpoint [m^gdim]
    lowest: Vector
    highest: Vector
    volume: Vector

    @staticmethod
    def of(domain: Mesh, bodies: Bodies) -> CellGeometry:
        """Measure the cells of a mesh."""
        body = bodies.of_cell
        type_, nodes = cell_type(domain), _compat.geometry_cells(domain)[: body.size]
        degree = _compat.geometry_degree(domain)
        x = np.ascontiguousarray(domain.geometry.x[:, : domain.geometry.dim].T)
        midpoint = np.empty((len(x), body.size))
        size, lowest, highest, volume = np.empty((4, body.size))
        gradients = _gradients(type_, degree)
        for batch in batches(body.size, _CELLS):
            places = x[:, nodes[batch].T]
            midpoint[:, batch], size[batch] = _midpoints_and_sizes(places, type_)
            values = determinants(np.array([D @ places for D in gradients]))
            volume[batch] = values[-1]
            lowest[batch], highest[batch] = values.min(axis=0), values.max(axis=0)
        nodes = nodes[:, : type_.vertices]
        return CellGeometry(
            domain, bodies, type_, nodes, x, midpoint, size, lowest, highest, volume
        )

    @property
    def body(self) -> Numbers:
        """The body of each cell."""
        return self.bodies.of_cell

    def shortest_edges(self, cells: Numbers) -> Vector:
        """Return the length of some cells' shortest edges whose length is not zero."""
        size, corners = self.size[cells], self.x[:, self.nodes[cells].T]
        shortest = size.copy()
        for a, b in self.type.edges:
            length = np.linalg.norm(corners[:, a] - corners[:, b], axis=0)
            np.minimum(shortest, length, out=shortest, where=length > FLAT_CELL * size)
        return shortest

    def raise_for(self, wrong: Mask, what: str, remedy: str) -> None:
        """Raise on all ranks if any has wrong cells, naming the first by its coordinates."""
        comm = self.domain.comm
        points = concatenate_ranks(comm, self.midpoint[:, wrong].T)
        body = concatenate_ranks(comm, self.body[wrong])
        if not len(points):
            return
        where = "around" if len(points) == 1 else "the first around"
        name = self.bodies.names[body[coordinate_order(points)[0]]]
        raise InputError(
            f"the mesh has {what}: {len(points)} of {comm.allreduce(self.body.size)} cells, "
            f"{where} {first_mesh_point(self.domain, points)} in {name}. {remedy}"
        )


def folded_cells(type_: ReferenceCell, nodes: Numbers, x: Vector) -> Mask:
    """Tell in which cells of degree 2 det J changes its sign, or vanishes.

    The nodes (m, n) are rows of the coordinates x (k, gdim), in the order of dolfinx.
    """
    folded, gradients, x = np.empty(len(nodes), dtype=bool), _gradients(type_, 2), x.T
    for batch in batches(len(nodes), _CELLS):
        places = x[:, nodes[batch].T]
        values = determinants(np.array([D @ places for D in gradients]))
        scale = FLAT_CELL * _midpoints_and_sizes(places, type_)[1] ** len(x)
        folded[batch] = _is_folded(values.min(axis=0), values.max(axis=0), scale)
    return folded


def _gradients(type_: ReferenceCell, degree: int) -> Vector:
    """Return derivatives of the shape functions where det J is tested: at nodes and midpoint."""
    points = lagrange_points(type_.name, degree)
    # in simplices of degree 1 the determinant is constant
    constant = type_.is_simplex and degree == 1
    points = np.vstack([points[: 0 if constant else None], points.mean(axis=0)])
    return shape_gradients(type_.name, degree, points)


def _midpoints_and_sizes(places: Vector, type_: ReferenceCell) -> tuple[Vector, Vector]:
    """Return midpoints (gdim, m) and sizes (m,) of cells with nodes (gdim, n, m)."""
    corners = places[:, : type_.vertices]
    midpoint = corners.mean(axis=1)
    spokes = corners - midpoint[:, None]
    return midpoint, 2.0 * np.sqrt(np.sum(spokes**2, axis=0).max(axis=0))


def _is_folded(lowest: Vector, highest: Vector, scale: Vector) -> Mask:
    """Tell where det J, between two values, changes its sign or vanishes."""
    return (lowest < scale) & (highest > -scale)


def check_cells(domain: Mesh, bodies: Bodies) -> CellGeometry:
    """Check that nodes are somewhere and cells are not degenerate. Collective."""
    with raise_collectively(domain.comm):
        bad = np.count_nonzero(~np.isfinite(domain.geometry.x).all(axis=1))
        if bad:
            raise InputError(
                f"{bad} of {len(domain.geometry.x)} nodes of the mesh on rank {domain.comm.rank} "
                "have coordinates that are NaN or infinite"
            )
    cells = CellGeometry.of(domain, bodies)
    _check_shapes(cells)
    return cells


# -- single cells ------------------------------------------------------------------------------


def _check_shapes(cells: CellGeometry) -> None:
    """Check that det J, whose sign dolfinx ignores, has one sign and is not zero. Collective."""
    dim = len(cells.x)
    scale = FLAT_CELL * cells.size**dim
    curved = _compat.geometry_degree(cells.domain) == 2
    kind = "curved cells that are folded:" if curved else "twisted cells, in which"
    sign = f"{kind} the determinant of the Jacobian changes its sign"
    remedy = (
        "Straighten their sides by read_msh(..., straighten=True), or mesh there finer"
        if curved
        else "Check that their vertices are in the order of dolfinx (those of a quadrilateral row "
        "by row, not around it); otherwise mesh there again"
    )
    cells.raise_for((cells.lowest < -scale) & (cells.highest > scale), sign, remedy)
    what = "volume (det J / size^3" if dim == 3 else "area (det J / size^2"
    cells.raise_for(
        np.abs(cells.volume) <= scale,
        f"cells without {what} is below {FLAT_CELL:g})",
        "Mesh there again, or remove these cells",
    )
    if curved:
        cells.raise_for(_is_folded(cells.lowest, cells.highest, scale), sign, remedy)


# -- neighbours --------------------------------------------------------------------------------


def check_overlaps(cells: CellGeometry) -> None:
    """Check that the two cells of a facet are on different sides of it. Collective."""
    facets, above = cell_facets(cells.domain)[: cells.body.size], _above(cells)
    number = int(facets.max(initial=-1)) + 1
    crowded = np.zeros(number, dtype=bool)
    for side in (above, ~above):
        crowded |= np.bincount(facets[side], minlength=number) > 1
    folded = np.count_nonzero(crowded[facets], axis=1)
    # a cell turned inside out has several such facets, each of its neighbours one
    largest = cells.domain.comm.allreduce(int(folded.max(initial=0)), MPI.MAX)
    cells.raise_for(
        (folded > 0) & (folded == largest),
        "cells that overlap their neighbours, on the same side of a common facet",
        "A vertex was moved through the opposite side: mesh there again",
    )


def _above(cells: CellGeometry) -> Mask:
    """Tell for each facet of each cell on which side of it the cell is.

    A cell of positive volume orients its facets, the k-th by (-1)^k and the order of its vertices;
    cells on the two sides of a facet give it opposite orientations.
    """
    above = np.empty((cells.body.size, len(cells.type.facets)), dtype=bool)
    for batch in batches(cells.body.size, _CELLS):
        nodes, positive = cells.nodes[batch].T.copy(), cells.volume[batch] > 0.0
        for k, facet in enumerate(cells.type.facets):
            above[batch, k] = _odd(nodes[list(facet)]) ^ positive ^ bool(k % 2)
    return above


def _odd(nodes: Indices) -> Mask:
    """Tell which facets (v, k) have their vertices in an order that reverses the orientation."""
    if len(nodes) == 4:  # a quadrilateral by its diagonals: the ends of each, then the two
        first, second = nodes[[0, 3]], nodes[[1, 2]]
        odd: Mask = _odd(first) ^ _odd(second) ^ (first.min(axis=0) > second.min(axis=0))
    else:
        odd = np.bitwise_xor.reduce([a > b for a, b in combinations(nodes, 2)])
    return odd
