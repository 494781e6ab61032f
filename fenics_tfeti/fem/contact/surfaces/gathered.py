"""Tagged surfaces, deformed or not, gathered from all ranks: points, facets and normals."""

from __future__ import annotations

from collections.abc import Sequence
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
from fenics_tfeti.fem.tolerances import VANISHING_NORMAL
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class GatheredSurface:
    """Facets of all ranks, or of those near this rank's part of another surface."""

    nodes: Numbers  # global nodes of the displacement's space (n,), ascending
    points: Vector  # deformed coordinates (n, gdim) [m]
    displacement: Vector  # (n, gdim) [m]
    facets: Numbers  # (m, t): rows of nodes, in the order of `Facets`

    @staticmethod
    def of(parts: Sequence[Message]) -> GatheredSurface:
        """Join parts of several ranks."""
        numbers = np.concatenate([nodes for nodes, _, _ in parts])
        values = np.concatenate([values for _, values, _ in parts])
        facets = np.concatenate([nodes.take(facets) for nodes, _, facets in parts])
        nodes, first = np.unique(numbers, return_index=True)
        points, moves = np.split(values[first], 2, axis=1)
        return GatheredSurface(nodes, points, moves, np.searchsorted(nodes, facets))

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
) -> GatheredSurface:
    """Gather a tagged surface from all ranks, deformed by a displacement [m] if given. Collective.

    The ghosts of the displacement are up to date.
    """
    part = SurfacePart.of(boundary, facet_tags, tag, displacement)
    return GatheredSurface.of(boundary.nodes.comm.allgather(part.packed()))


Message = tuple[Numbers, Vector, Numbers]


@dataclass(frozen=True)
class SurfacePart:
    """The facets of a surface that this rank owns."""

    boundary: MeshBoundary
    facets: Numbers  # (m, t): local nodes, in the order of `Facets`
    points: Vector  # (nodes, gdim): coordinates of all local nodes, deformed or not [m]
    displacement: Vector  # (nodes, gdim) [m]

    @staticmethod
    def of(
        boundary: MeshBoundary, facet_tags: Any, tag: int, displacement: Function | None
    ) -> SurfacePart:
        """Find the facets with a tag."""
        space = boundary.space
        facets = oriented_facets(space, owned_facets(space.mesh, facet_tags, tag))
        points = boundary.coordinates[:, : boundary.nodes.components]
        moves = np.zeros_like(points)
        if displacement is not None:
            moves = boundary.nodes.values(displacement)[: len(points)]
        return SurfacePart(boundary, facets.astype(np.int64), points + moves, moves)

    def packed(self, chosen: Numbers | slice = slice(None)) -> Message:
        """Return the nodes of some facets with coordinates and displacements, and the facets."""
        local, rows = np.unique(self.facets[chosen], return_inverse=True)
        values = np.concatenate([self.points[local], self.displacement[local]], axis=1)
        rows = rows.reshape(-1, self.facets.shape[1]).astype(np.int32)
        return self.boundary.nodes.to_global(local), values, rows
