"""Tagged surfaces of a deformed mesh, gathered on every rank: points, facets and normals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.contact.mortar.facets import Facets
from fenics_tfeti.fem.contact.surfaces.faceted import FacetedSurface
from fenics_tfeti.fem.contact.surfaces.oriented import (
    corner_normals,
    oriented_facets,
    owned_facets,
)
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import VANISHING_NORMAL
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class DeformedSurface:
    """A deformed surface of all ranks, on every rank."""

    nodes: Numbers  # global nodes of the displacement's space (n,), ascending
    points: Vector  # deformed coordinates (n, gdim) [m]
    displacement: Vector  # (n, gdim) [m]
    facets: Numbers  # (m, t): rows of nodes, in the order of `Facets`

    @cached_property
    def surface(self) -> Facets:
        """The facets."""
        return Facets(self.points, self.facets)

    def faceted(self) -> FacetedSurface:
        """Return the surface of segments or triangles, four for each quadrilateral.

        Facets of degree 2 are replaced by their pieces.
        """
        return FacetedSurface(self._with_centres(self.points), self._simplices())

    def from_corners(self, values: Vector) -> Vector:
        """Return values (n, ...) at all nodes, interpolated by those at the facets' corners."""
        corners, t = self.surface.corners, self.facets.shape[1]
        filled, v = values.copy(), corners.shape[1]
        for k in range(v, t):
            ends = [k - v, (k - v + 1) % v] if k < 2 * v else list(range(v))
            filled[self.facets[:, k]] = values[corners[:, ends]].mean(axis=1)
        return filled

    def interpolate(self, values: Vector, x: Vector) -> Vector:
        """Interpolate nodal values (n, v) at the points of the undeformed surface closest to x.

        They are linear on segments and triangles, or the pieces of facets of degree 2.
        """
        simplices = self._simplices()
        undeformed = FacetedSurface(self._with_centres(self.points - self.displacement), simplices)
        facet, weights = undeformed.closest(x)
        corners = self._with_centres(values)[simplices[facet]]
        interpolated: Vector = np.einsum("kc,kcv->kv", weights, corners)
        return interpolated

    def normals(self, name: str) -> Vector:
        """Return the unit normals (n, gdim), by integrals with the shape functions.

        For degree 2 they are those of the pieces of facets.
        """
        pieces = self.surface.pieces
        weighted = corner_normals(self.points[pieces])
        total, size = np.zeros_like(self.points), np.zeros(len(self.nodes))
        np.add.at(total, pieces, weighted)
        np.add.at(size, pieces, np.linalg.norm(weighted, axis=2))
        length = np.linalg.norm(total, axis=1)
        folded = np.flatnonzero(length <= VANISHING_NORMAL * size)
        if folded.size:
            place = format_point(self.points[folded[0]], float(np.abs(self.points).max()))
            raise InputError(
                f"{name}: the displacement has folded the slave's facets at {folded.size} nodes, "
                f"the first now at {place}: their normals cancel. Check the loads, and whether the "
                "displacements are small enough for linear elasticity"
            )
        units: Vector = total / length[:, None]
        return units

    def _simplices(self) -> Numbers:
        """Return segments or triangles; a quadrilateral is four triangles around its centre."""
        pieces = self.surface.pieces
        if pieces.shape[1] != 4:
            return pieces
        centre = len(self.points) + np.arange(len(pieces))
        triangles = [
            np.column_stack([start, end, centre])
            for start, end in zip(pieces.T, np.roll(pieces, -1, axis=1).T, strict=True)
        ]
        return np.concatenate(triangles)

    def _with_centres(self, values: Vector) -> Vector:
        """Return values at nodes, followed by those at the centres of quadrilaterals."""
        pieces = self.surface.pieces
        if pieces.shape[1] != 4:
            return values
        return np.concatenate([values, values[pieces].mean(axis=1)])


def gather_surface(
    boundary: MeshBoundary, facet_tags: Any, tag: int, displacement: Function | None = None
) -> DeformedSurface:
    """Gather a tagged surface from all ranks, deformed by a displacement [m] if given. Collective.

    The ghosts of the displacement are up to date.
    """
    space = boundary.space
    comm, gdim = space.mesh.comm, space.dofmap.index_map_bs
    facets = oriented_facets(space, owned_facets(space.mesh, facet_tags, tag))
    local = np.unique(facets)
    numbers = NodeMap(space).to_global(local)
    points = boundary.coordinates[local, :gdim]
    moves = np.zeros_like(points)
    if displacement is not None:
        moves = displacement.x.array.reshape(-1, gdim)[local]
    rows = numbers[np.searchsorted(local, facets)]
    numbers, points, moves, rows = (
        concatenate_ranks(comm, column) for column in (numbers, points, moves, rows)
    )
    nodes, first = np.unique(numbers, return_index=True)
    return DeformedSurface(
        nodes, points[first] + moves[first], moves[first], np.searchsorted(nodes, rows)
    )
