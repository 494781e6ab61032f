"""Facets of tagged surfaces, deformed or not: this rank's, those near it, or all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.facets import Facets
from fenics_tfeti.fem.geometry.normals import corner_normals
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.tolerances import VANISHING_NORMAL
from fenics_tfeti.typing import Numbers, Vector


def folded(name: str, number: int, place: str) -> InputError:
    """Return the error that the normals of the facets around some nodes cancel."""
    return InputError(
        f"{name}: the displacement has folded the slave's facets at {number} nodes, the first now "
        f"at {place}: their normals cancel. Check the loads, and whether the displacements are "
        "small enough for linear elasticity"
    )


@dataclass(frozen=True)
class SurfaceFacets:
    """Facets of a surface with the global numbers of their nodes."""

    nodes: Numbers  # global nodes of the displacement's space (n,), ascending
    facets: Facets  # their nodes are rows of `nodes`
    # (n, gdim): unit normals of the whole surface at vertices, zero elsewhere; by default `normal`
    # is found from these facets alone
    vertex_normals: Vector | None = None
    weight: Vector | None = None  # (n,): weight of the measure at vertices
    number: Numbers | None = None  # (f,): of facets, such as those of their faces

    @staticmethod
    def joined(parts: Sequence[SurfaceFacets]) -> SurfaceFacets:
        """Join parts of several ranks."""
        numbers = np.concatenate([part.nodes for part in parts])
        facets = np.concatenate([part.nodes.take(part.facets.nodes) for part in parts])
        nodes, first = np.unique(numbers, return_index=True)
        points = np.concatenate([part.points for part in parts])[first]
        of_parts = [part.facets.contact for part in parts]
        contact = None
        if of_parts[0] is not None:
            contact = np.concatenate([part for part in of_parts if part is not None])[first]
        numbers_of = [part.number for part in parts if part.number is not None]
        return SurfaceFacets(
            nodes,
            Facets(points, np.searchsorted(nodes, facets), contact),
            number=np.concatenate(numbers_of) if numbers_of else None,
        )

    @property
    def points(self) -> Vector:
        """The places of the nodes, deformed or not (n, gdim) [m]."""
        return self.facets.points

    @property
    def corner_weight(self) -> Vector | None:
        """The weight of the measure at the corners (f, v)."""
        return None if self.weight is None else self.weight[self.facets.corners]

    @cached_property
    def normal(self) -> Vector:
        """Unit normals (n, gdim), by integrals with the shape functions; zero where they cancel."""
        if self.vertex_normals is not None:
            return self.vertex_normals
        return unit(self._integrals[0])

    @cached_property
    def _integrals(self) -> tuple[Vector, Vector]:
        """Integrals of the normal (n, gdim) and of its length (n,) with the shape functions."""
        pieces = self.facets.pieces
        weighted = corner_normals(self.points[pieces])
        total, size = np.zeros_like(self.points), np.zeros(len(self.nodes))
        np.add.at(total, pieces, weighted)
        np.add.at(size, pieces, np.linalg.norm(weighted, axis=2))
        return total, size

    def check_not_folded(self, *names: str) -> None:
        """Check that the normals of the facets around each node do not cancel.

        The names are those of the contacts.
        """
        total, size = self._integrals
        length = np.linalg.norm(total, axis=1)
        is_folded = np.flatnonzero(length <= VANISHING_NORMAL * size)
        if is_folded.size:
            place = format_point(self.points[is_folded[0]], float(np.abs(self.points).max()))
            name = names[int(self.facets.contact_of(is_folded[:1])[0])]
            raise folded(name, is_folded.size, place)

    def from_corners(self, values: Vector) -> Vector:
        """Return values (n, ...) at all nodes, interpolated by those at the facets' corners."""
        corners, t = self.facets.corners, self.facets.nodes.shape[1]
        filled, v = values.copy(), corners.shape[1]
        for k in range(v, t):
            ends = [k - v, (k - v + 1) % v] if k < 2 * v else list(range(v))
            filled[self.facets.nodes[:, k]] = values[corners[:, ends]].mean(axis=1)
        return filled

    def interpolate(self, values: Vector, x: Vector) -> Vector:
        """Interpolate nodal values (n, v) on simplices at their points closest to x."""
        facet, weights = FacetedSurface.of(self.facets).closest(x)
        corners = self.facets.with_centres(values)[self.facets.simplices()[facet]]
        return np.einsum("kc,kcv->kv", weights, corners)
