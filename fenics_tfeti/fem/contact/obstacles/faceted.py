"""Rigid obstacles by facets: of arrays, STL files, or a tagged surface of a mesh."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.faceted import FacetedSurface, facet_normals
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.user_data import as_points, is_number
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# bytes of a binary STL file before its triangles, and the layout of these
_STL_HEADER = 84
_STL_TRIANGLE = np.dtype([("vectors", "<f4", (4, 3)), ("attributes", "<u2")])


@dataclass(frozen=True, eq=False)
class FacetedObstacle:
    """A rigid obstacle whose surface is made of segments (2D) or triangles (3D).

    The surface is open or closed. Facets are oriented: seen from outside, the corners of a triangle
    follow each other anticlockwise; along a segment the outside is on the right.

    Attributes
    ----------
    points : (n, gdim) array-like
        Corners [m].
    facets : (m, gdim) integer array-like
        The corners of each facet, rows of `points`.

    Raises
    ------
    InputError
        If there are no facets, or they have no size or other corners than `points`.

    Examples
    --------
    >>> ground = FacetedObstacle(points=[(1, 0), (0, 0)], facets=[(0, 1)])
    >>> gap, normal = ground(np.array([[0.5], [0.2], [0.0]]))
    >>> gap.tolist(), normal.ravel().tolist()
    ([0.2], [0.0, 1.0])
    """

    points: ArrayLike
    facets: ArrayLike

    def __post_init__(self) -> None:
        """Check the data."""
        points = as_points(self.points, "FacetedObstacle: the points")
        facets = np.asarray(self.facets)
        gdim = points.shape[1]
        if facets.ndim != 2 or facets.shape[1] != gdim or facets.dtype.kind not in "iu":
            raise InputError(
                f"FacetedObstacle: the facets have shape {facets.shape} and type {facets.dtype}; "
                f"integers of shape (m, {gdim}) are expected, {gdim} corners for each"
            )
        if not len(facets) or facets.min() < 0 or facets.max() >= len(points):
            raise InputError(
                f"FacetedObstacle: {len(facets)} facets with corners that are not all rows of the "
                f"{len(points)} points"
            )
        if not np.linalg.norm(facet_normals(points[facets]), axis=1).any():
            raise InputError("FacetedObstacle: no facet has a size")

    @staticmethod
    def from_stl(path: str | os.PathLike[str], scale: float = 1.0) -> FacetedObstacle:
        """Read an STL file, of text or binary.

        Parameters
        ----------
        path : path-like
            The file; each rank reads it.
        scale : float
            Factor of the coordinates, such as 1e-3 for a file in mm.

        Raises
        ------
        InputError
            If the file has no triangles, or is no STL file.
        OSError
            If it cannot be read.
        """
        if not is_number(scale) or scale <= 0.0:
            raise InputError(f"from_stl: scale is {scale!r}; a positive number is expected")
        corners = _stl_corners(Path(path)) * scale
        points, facets = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        return FacetedObstacle(points, facets.reshape(-1, 3))

    @staticmethod
    def from_mesh(mesh: Mesh, facet_tags: Any, tag: int) -> FacetedObstacle:
        """Take the surface of a mesh's facets with a tag. Collective.

        The mesh is that of the rigid body, which is no part of the problem's mesh.

        Raises
        ------
        InputError
            If the tag is on no facet.
        """
        boundary = MeshBoundary.of(
            _compat.lagrange_space(mesh, _compat.geometry_degree(mesh), mesh.geometry.dim)
        )
        surface = tagged_surface(boundary, facet_tags, tag, "the obstacle")
        facets = surface.gathered().facets
        with raise_collectively(mesh.comm):
            return FacetedObstacle(facets.with_centres(facets.points), facets.simplices())

    @cached_property
    def _surface(self) -> FacetedSurface:
        points, facets = np.asarray(self.points, dtype=float), np.asarray(self.facets)
        whole = np.linalg.norm(facet_normals(points[facets]), axis=1) > 0.0
        return FacetedSurface(points, facets[whole].astype(np.int64))

    def __call__(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distances and normals at points x of shape (3, n)."""
        gdim = np.shape(self.points)[1]
        distance = self._surface.distance(np.ascontiguousarray(x[:gdim].T))
        return distance.signed, distance.normal.T


def _stl_corners(path: Path) -> NDArray[np.float64]:
    """Return the corners (m, 3, 3) of the triangles of a file."""
    content = path.read_bytes()
    count = int(np.frombuffer(content[80:_STL_HEADER], "<u4")[0]) if len(content) > 84 else 0
    if count and len(content) == _STL_HEADER + count * _STL_TRIANGLE.itemsize:
        triangles = np.frombuffer(content, _STL_TRIANGLE, count, _STL_HEADER)
        return triangles["vectors"][:, 1:].astype(np.float64)
    words = content.split()
    places = [k for k, word in enumerate(words) if word.lower() == b"vertex"]
    try:
        corners = np.array([[float(w) for w in words[k + 1 : k + 4]] for k in places])
        if not len(corners):
            raise ValueError("no triangles")
        return corners.reshape(-1, 3, 3)
    except ValueError as error:
        raise InputError(f"{path}: not an STL file: {error}") from None
