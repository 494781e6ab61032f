"""Normals of faceted surfaces, corrected where these stand for others.

In planes of symmetry: at the border of a curved surface, facets on one side alone enter the mean of
their normals. Where the displacement across a plane is prescribed, the mean of the whole surface
has no component across it.

On round cylinders: facets that are no strips along the axis have normals that are tilted along it
to either side, by up to 1e-2, those of curved cells by 1e-6. Nothing else holds a loose pin in a
hole along its axis: it would move until the axial parts of tilted forces cancel, by many times what
the bodies deform. Facets whose corners are on a round cylinder stand for that surface: the tilt is
their error and is removed. Then the motion along the axis is a free one.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.geometry.vectors import unit
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING, SAME_PLACE
from fenics_tfeti.typing import Mask, Numbers, Vector

# root mean square of the normals along a second direction, below which a surface is a plane
_CURVED = 0.1
# distance of nodes from a cylinder, relative to its size, that is rounding
_ROUND = 1e-11


def normals_in_symmetry_planes(surface: Surface, prescribed: Mask) -> Vector:
    """Return a surface's unit normals without components that symmetry rules out. Collective.

    A prescribed component (k, gdim) is left out if it is larger at the neighbours where it is not
    prescribed, as on a curved surface; on planes it is the same there.
    """
    normal = np.abs(surface.at_corners(surface.normal))
    fixed = surface.at_corners(prescribed)
    values = np.where(fixed, 0.0, normal), (~fixed).astype(float)
    of_facets = np.concatenate(values, axis=2).sum(axis=1, keepdims=True)
    v = fixed.shape[1]
    total = surface.sum_of_corners(np.repeat(of_facets, v, axis=1))
    gdim = surface.normal.shape[1]
    neighbour_mean = total[:, :gdim] / np.maximum(total[:, gdim:], 1.0)
    # of a curved surface a component is twice as large at neighbours on a uniform mesh, of a plane,
    # inclined or not, as large
    removed = prescribed & (neighbour_mean > 1.3 * np.abs(surface.normal))
    projected = np.where(removed, 0.0, surface.normal)
    length = np.linalg.norm(projected, axis=1)
    # where less is left, the prescribed components are no symmetry
    curved = length > 0.5
    return np.where(
        curved[:, None], projected / np.where(curved, length, 1.0)[:, None], surface.normal
    )


def axes_of_cylinders(surface: Surface, nodes: Numbers, normal: Vector) -> list[Vector | None]:
    """Return the axes at the nodes (s,) of each slave whose contact is round. Collective.

    The nodes (k,) with contact conditions have the normals (k, gdim). If those of a contact are on
    a round cylinder, its axes (s, 3) are unit vectors at nodes whose facets are all on it, zero at
    others, such as those of a pin's ends.
    """
    count = len(surface.extent)
    if normal.shape[1] != 3:
        return [None] * count
    rows = np.searchsorted(surface.nodes, nodes)
    contact, corners = surface.contact[rows], surface.corners
    axes, limits = np.zeros((count, 3)), np.zeros(count)
    distance = np.zeros(corners.shape[:2])
    for k in np.flatnonzero(_are_curved(surface, contact, normal)):
        of_contact, of_facets = contact == k, surface.facet_contact == k
        points = surface.points[rows[of_contact]]
        if cylinder := FittedCylinder.of(surface.comm, points, normal[of_contact]):
            axes[k], limits[k] = cylinder.axis, cylinder.tolerance
            places = corners[of_facets]
            on = np.abs(cylinder.distance(places.reshape(-1, 3)))
            distance[of_facets] = on.reshape(places.shape[:2])
    if not axes.any():
        return [None] * count
    farthest, of_node = surface.max_of_facets(distance.max(axis=1)), surface.contact
    at_nodes = np.where((farthest <= limits[of_node])[:, None], axes[of_node], 0.0)
    of_contacts = np.split(at_nodes, np.searchsorted(of_node, np.arange(1, count)))
    return [part if axis.any() else None for part, axis in zip(of_contacts, axes, strict=True)]


def without_axial_tilt(normal: Vector, axis: Vector) -> Vector:
    """Return unit normals (k, 3) across axes (k, 3), where these are not zero."""
    tilt = np.sum(normal * axis, axis=1)
    is_tilted = np.abs(tilt) > COORDINATE_ROUNDING
    normal, radial = normal.copy(), normal - tilt[:, None] * axis
    normal[is_tilted] = unit(radial[is_tilted])
    return normal


def _are_curved(surface: Surface, contact: Numbers, normal: Vector) -> Mask:
    """Tell which contacts have normals along more than one direction. Collective."""
    sums = np.zeros((len(surface.extent), 10))
    products = (normal[:, :, None] * normal[:, None]).reshape(-1, 9)
    np.add.at(sums, contact, np.column_stack([products, np.ones(len(normal))]))
    surface.comm.Allreduce(MPI.IN_PLACE, sums)
    squares = np.linalg.eigvalsh(sums[:, :9].reshape(-1, 3, 3) / np.maximum(sums[:, 9:, None], 1.0))
    return squares[:, 1] >= _CURVED**2


@dataclass(frozen=True)
class FittedCylinder:
    """A round cylinder."""

    centre: Vector  # (3,): a point on the axis [m]
    axis: Vector  # (3,): a unit vector
    radius: float  # [m]
    tolerance: float = 0.0  # largest distance of points that are on it [m]

    @staticmethod
    def of(comm: MPI.Intracomm, points: Vector, normals: Vector) -> FittedCylinder | None:
        """Return the cylinder on which points are, to rounding; None if there is none. Collective.

        A load across the axis must do no work along it. Points of few digits tell their axis if
        they mean a coordinate axis. The normals (k, 3) are about the unit normals at this rank's
        points (k, 3).
        """
        number = comm.allreduce(float(len(points)))
        squares, directions = np.linalg.eigh(comm.allreduce(normals.T @ normals) / (number or 1.0))
        if squares[1] < _CURVED**2:
            return None
        middle, mean = comm.allreduce(np.array([points.sum(axis=0), normals.sum(axis=0)])) / number
        size = comm.allreduce(float(np.abs(points - middle).max(initial=0.0)), MPI.MAX)
        x, axis_estimate, cross_axes = (points - middle) / size, directions[:, 0], directions[:, 1:]
        # x - r n is about the same point everywhere
        n = (normals - mean) @ cross_axes
        xn, nn = comm.allreduce(np.array([np.sum((x @ cross_axes) * n), np.sum(n * n)]))
        fit = FittedCylinder(-xn / nn * mean, axis_estimate, float(abs(xn / nn)))
        for _ in range(8):
            fit = fit._improved(comm, x, cross_axes)
        misfit = comm.allreduce(float(np.abs(fit.distance(x)).max(initial=0.0)), MPI.MAX)
        nearest = np.argmax(np.abs(fit.axis))
        coordinate_axis = np.eye(3)[nearest] * np.sign(fit.axis[nearest])
        rotation = float(np.linalg.norm(fit.axis - coordinate_axis))
        # angles and distances of other nodes are some times what the misfit of these nodes is
        is_coordinate_axis = rotation <= 10.0 * max(misfit, _ROUND)
        if misfit > (SAME_PLACE if is_coordinate_axis else _ROUND):
            return None
        axis = coordinate_axis if is_coordinate_axis else fit.axis
        tolerance = size * (2.0 * max(misfit, _ROUND))
        return FittedCylinder(middle + size * fit.centre, axis, size * fit.radius, tolerance)

    def distance(self, points: Vector) -> Vector:
        """Return signed distances (k,) of points, positive outside [m]."""
        return np.linalg.norm(self._radial(points), axis=1) - self.radius

    def _radial(self, points: Vector) -> Vector:
        """Return the vectors (k, 3) from the axis to points [m]."""
        x = points - self.centre
        return x - np.outer(x @ self.axis, self.axis)

    def _improved(self, comm: MPI.Intracomm, x: Vector, cross_axes: Vector) -> FittedCylinder:
        """Return it after a step of Gauss and Newton towards points (k, 3) about 0. Collective."""
        radial = self._radial(x)
        distance, outward = np.linalg.norm(radial, axis=1), unit(radial) @ cross_axes
        rows = np.column_stack([outward, (x @ self.axis)[:, None] * outward, np.ones(len(x))])
        gram = comm.allreduce(rows.T @ np.column_stack([rows, distance - self.radius]))
        step = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=None)[0]
        axis, centre = self.axis + cross_axes @ step[2:4], self.centre + cross_axes @ step[:2]
        centre = centre - self.axis * (centre @ self.axis)
        return FittedCylinder(centre, axis / np.linalg.norm(axis), self.radius + float(step[4]))
