"""Rigid obstacles x -> (gap, normal): plane, sphere, cylinder, facets, and the user's, checked."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, tagged_surface
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.normals import facet_normals
from fenics_tfeti.fem.tolerances import NO_DIRECTION
from fenics_tfeti.fem.user_data import as_coordinates, as_direction, as_points, check_positive
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# bytes of a binary STL file before its triangles, and the layout of these
_STL_HEADER = 84
_STL_TRIANGLE = np.dtype([("vectors", "<f4", (4, 3)), ("attributes", "<u2")])

Obstacle = Callable[[Vector], tuple[ArrayLike, ArrayLike] | ArrayLike]


@dataclass(frozen=True)
class Plane:
    """A rigid half space (in 2D half plane).

    Attributes
    ----------
    point : sequence of float
        A point of its boundary [m].
    normal : sequence of float
        Normal of the boundary that points out of the obstacle, towards the body; of any length.

    Raises
    ------
    InputError
        If the normal has length zero, or the point has fewer coordinates than the normal.

    Examples
    --------
    >>> gap, normal = Plane(point=(0, 0, 0), normal=(0, 0, 2))(np.array([[0.0], [0.0], [0.5]]))
    >>> gap.tolist(), normal.ravel().tolist()
    ([0.5], [0.0, 0.0, 1.0])
    """

    point: Sequence[float]
    normal: Sequence[float]

    def __post_init__(self) -> None:
        normal = as_direction(self.normal, "the plane's normal")
        if as_coordinates(self.point, "the plane's point").size < normal.size:
            raise InputError(
                f"the plane's point {self.point} has fewer coordinates than its normal "
                f"{self.normal}"
            )

    def __call__(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distances and normals at points x of shape (3, n)."""
        unit = as_direction(self.normal, "the plane's normal")
        gdim = unit.size
        gap = unit @ (x[:gdim] - np.asarray(self.point, dtype=float)[:gdim, None])
        return gap, np.tile(unit[:, None], (1, x.shape[1]))


@dataclass(frozen=True)
class Sphere:
    """A rigid ball (in 2D a disc), or with `hollow` the space around it.

    Attributes
    ----------
    centre : sequence of float
        [m].
    radius : float
        [m].
    hollow : bool
        Whether the body is inside the sphere and the obstacle around it.

    Raises
    ------
    InputError
        If the radius is not positive, or a point is at the centre, where the normal is not defined.

    Examples
    --------
    >>> x = np.array([[0.0], [0.0], [3.0]])
    >>> gap, normal = Sphere(centre=(0, 0, 0), radius=2)(x)
    >>> gap.tolist(), normal.ravel().tolist()
    ([1.0], [0.0, 0.0, 1.0])
    >>> gap, normal = Sphere(centre=(0, 0, 0), radius=4, hollow=True)(x)
    >>> gap.tolist(), normal[2].tolist()
    ([1.0], [-1.0])
    """

    centre: Sequence[float]
    radius: float
    hollow: bool = False

    def __post_init__(self) -> None:
        as_coordinates(self.centre, "the sphere's centre")
        check_positive(self.radius, "the sphere's radius")

    def __call__(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distances and normals at points x of shape (3, n)."""
        centre = np.asarray(self.centre, dtype=float)
        outward = x[: centre.size] - centre[:, None]
        return _radial_gap(x, outward, self.radius, self.hollow, "at the centre of the sphere")


@dataclass(frozen=True)
class Cylinder:
    """A rigid cylinder of infinite length, or with `hollow` the space around it.

    In 2D use `Sphere`, which is a disc there.

    Attributes
    ----------
    point : (3,) sequence of float
        A point of its axis [m].
    axis : (3,) sequence of float
        Direction of its axis; of any length and either sense.
    radius : float
        [m].
    hollow : bool
        Whether the body is inside the cylinder and the obstacle around it.

    Raises
    ------
    InputError
        If the axis has length zero, the radius is not positive, or a point is on the axis, where
        the normal is not defined.

    Examples
    --------
    >>> x = np.array([[3.0], [7.0], [4.0]])
    >>> gap, normal = Cylinder(point=(0, 0, 0), axis=(0, 1, 0), radius=2)(x)
    >>> gap.tolist(), normal.ravel().tolist()
    ([3.0], [0.6, 0.0, 0.8])
    >>> Cylinder(point=(0, 0, 0), axis=(0, 1, 0), radius=6, hollow=True)(x)[0].tolist()
    [1.0]
    """

    point: Sequence[float]
    axis: Sequence[float]
    radius: float
    hollow: bool = False

    def __post_init__(self) -> None:
        sizes = (
            as_coordinates(self.point, "the cylinder's point").size,
            as_direction(self.axis, "the cylinder's axis").size,
        )
        if sizes != (3, 3):
            raise InputError(
                f"the cylinder's point {self.point} and axis {self.axis} need three coordinates "
                "each; in 2D use Sphere, which is a disc there"
            )
        check_positive(self.radius, "the cylinder's radius")

    def __call__(self, x: Vector) -> tuple[Vector, Vector]:
        """Return the distances and normals at points x of shape (3, n)."""
        axis = as_direction(self.axis, "the cylinder's axis")
        offset = x - np.asarray(self.point, dtype=float)[:, None]
        outward = offset - axis[:, None] * (axis @ offset)
        return _radial_gap(x, outward, self.radius, self.hollow, "on the axis of the cylinder")


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
        check_positive(scale, "from_stl: scale")
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


def _radial_gap(
    x: Vector, outward: Vector, radius: float, hollow: bool, where: str
) -> tuple[Vector, Vector]:
    """Return gaps and normals from the vectors that lead to points from a centre or an axis."""
    distance = np.linalg.norm(outward, axis=0)
    singular = np.flatnonzero(distance <= NO_DIRECTION * radius)
    if singular.size:
        point = format_point(x[: len(outward), singular[0]], radius)
        raise InputError(
            f"the point {point} is {where}, where the normal is not defined: remove it from "
            "the slave's surface, or move the obstacle"
        )
    sign = -1.0 if hollow else 1.0
    return sign * (distance - radius), sign * outward / distance


def _stl_corners(path: Path) -> Vector:
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
