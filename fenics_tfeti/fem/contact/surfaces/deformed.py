"""Tagged surfaces of a deformed mesh, gathered on every rank: points, facets and normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import Function, FunctionSpace

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.mortar.facets import Facets
from fenics_tfeti.fem.contact.surfaces.faceted import FacetedSurface, facet_normals
from fenics_tfeti.fem.reference_cells import reference_cell
from fenics_tfeti.fem.tolerances import VANISHING_NORMAL
from fenics_tfeti.fem.topology import cell_type, facet_vertices
from fenics_tfeti.parallel import concatenate_ranks

__all__ = ["DeformedSurface", "cyclic_corners", "gather_surface", "oriented_facets"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class DeformedSurface:
    """A deformed surface of all ranks, on every rank.

    Attributes
    ----------
    nodes : (n,) integer array
        Global nodes of the displacement's space, ascending.
    points : (n, gdim) array
        Deformed coordinates [m].
    displacement : (n, gdim) array
        Displacements [m].
    facets : (m, v) integer array
        Rows of `nodes`, in dolfinx's order of vertices and oriented outwards: of segments and
        triangles as `facet_normals` says, of quadrilaterals such that the tangents from vertex 0 to
        1 and 2 and the outward normal form a right-handed system.
    """

    nodes: Numbers
    points: Vector
    displacement: Vector
    facets: Numbers

    def cyclic(self) -> Facets:
        """Return the facets with their corners one after the other around each."""
        return Facets(self.points, cyclic_corners(self.facets))

    def faceted(self) -> FacetedSurface:
        """Return the surface of segments or triangles, four for each quadrilateral."""
        return FacetedSurface(self._with_centres(self.points), self._simplices())

    def interpolate(self, values: Vector, x: Vector) -> Vector:
        """Interpolate nodal values at the points of the undeformed surface closest to x.

        Parameters
        ----------
        values : (n, v) array
            At the nodes; linear on segments and triangles.
        x : (k, gdim) array
            Points [m].

        Returns
        -------
        (k, v) array
            Values at the closest points.
        """
        simplices = self._simplices()
        undeformed = FacetedSurface(self._with_centres(self.points - self.displacement), simplices)
        facet, weights = undeformed.closest(x)
        corners = self._with_centres(values)[simplices[facet]]
        interpolated: Vector = np.einsum("kc,kcv->kv", weights, corners)
        return interpolated

    def normals(self, name: str) -> Vector:
        """Return the unit normals at all nodes, by integrals with the shape functions.

        Raises
        ------
        InputError
            Facets whose normals cancel at a node, with the contact's name. The same on every rank.
        """
        weighted = _weighted_normals(self.points[self.facets])
        total, size = np.zeros_like(self.points), np.zeros(len(self.nodes))
        np.add.at(total, self.facets, weighted)
        np.add.at(size, self.facets, np.linalg.norm(weighted, axis=2))
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
        if self.facets.shape[1] != 4:
            return self.facets
        centre = len(self.points) + np.arange(len(self.facets))
        cycle = cyclic_corners(self.facets)
        triangles = [
            np.column_stack([start, end, centre])
            for start, end in zip(cycle.T, np.roll(cycle, -1, axis=1).T, strict=True)
        ]
        return np.concatenate(triangles)

    def _with_centres(self, values: Vector) -> Vector:
        """Return values at nodes, followed by those at the centres of quadrilaterals."""
        if self.facets.shape[1] != 4:
            return values
        return np.concatenate([values, values[self.facets].mean(axis=1)])


def gather_surface(
    space: FunctionSpace, facet_tags: Any, tag: int, displacement: Function | None = None
) -> DeformedSurface:
    """Gather a deformed tagged surface from all ranks. Collective.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    facet_tags : MeshTags
        Tags of facets.
    tag : int
        The surface's tag.
    displacement : Function, optional
        On the space [m], with ghosts up to date; by default the surface is not deformed.
    """
    comm, gdim = space.mesh.comm, space.dofmap.index_map_bs
    facets = oriented_facets(space, facet_tags, tag)
    local = np.unique(facets)
    numbers = np.asarray(space.dofmap.index_map.local_to_global(local), dtype=np.int64)
    points = space.tabulate_dof_coordinates()[local][:, :gdim]
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


def oriented_facets(space: FunctionSpace, facet_tags: Any, tag: int) -> NDArray[np.int32]:
    """Return the local nodes (f, v) of the facets that this rank owns, oriented outwards.

    The facets are in the order of their numbers, as in `Surface`, the nodes of each in the order
    that `DeformedSurface` has.
    """
    domain, dim = space.mesh, space.mesh.topology.dim
    domain.topology.create_connectivity(dim - 1, dim)
    found = facet_tags.find(tag)
    found = np.sort(found[found < domain.topology.index_map(dim - 1).size_local]).astype(np.int32)
    rows = facet_vertices(domain, found)
    to_cell = domain.topology.connectivity(dim - 1, dim)
    cells = np.asarray(to_cell.array)[np.asarray(to_cell.offsets)[found]]

    # cells of degree 1 list nodes and vertices in the same order
    of_cell, x = _compat.geometry_cells(domain), domain.geometry.x[:, :dim]
    node = np.zeros(len(x), dtype=np.int32)
    node[of_cell] = _compat.cell_dofs(space)
    outward = x[rows].mean(axis=1) - x[of_cell[cells]].mean(axis=1)
    inverted = np.sum(_weighted_normals(x[rows]).sum(axis=1) * outward, axis=1) < 0.0
    reflected = rows[:, cell_type(domain).facet.reflected]
    oriented = np.where(inverted[:, None], reflected, rows)
    return np.asarray(node[oriented], dtype=np.int32)


def cyclic_corners(facets: NDArray[Any]) -> NDArray[np.int64]:
    """Return the corners of facets (f, v) in dolfinx's order one after the other around each."""
    name = {2: "interval", 3: "triangle", 4: "quadrilateral"}[facets.shape[1]]
    return facets[:, reference_cell(name).vtk_order].astype(np.int64)


def _weighted_normals(corners: Vector) -> Vector:
    """Return the integrals over facets of the normal times the shape function of each corner.

    Parameters
    ----------
    corners : (m, v, gdim) array
        Corners of segments, triangles or bilinear quadrilaterals.

    Returns
    -------
    (m, v, gdim) array
        Exact also for warped quadrilaterals: the cross product of their tangents is linear.
    """
    v = corners.shape[1]
    if v < 4:
        return np.repeat(facet_normals(corners)[:, None, :] / v, v, axis=1)
    one = corners[:, [1, 1, 3, 3]] - corners[:, [0, 0, 2, 2]]
    other = corners[:, [2, 3, 2, 3]] - corners[:, [0, 1, 0, 1]]
    mass = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0
    weighted: Vector = np.einsum("ij,mjk->mik", np.kron(mass, mass), np.cross(one, other))
    return weighted
