"""Normals of faceted extrusions, such as cylinders, without their tilt along the axis.

Facets of a cylinder that are no strips along its axis have normals that are tilted along it to
either side, by about 1e-2, of degree 2 by 1e-6. Nothing else holds a pin in a hole along its axis:
contact forces whose axial parts do not cancel move it until they do, by many times what the bodies
deform. The axis is the direction across which the normals are on the whole. What they have along
it is removed if it is scatter, and not a slope or a crown of the surface: then the motion along the
axis is a free one, as it is of the surfaces that the facets stand for.
"""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.fem.tolerances import AXIAL_TILT, COORDINATE_ROUNDING

__all__ = ["without_axial_tilt"]

Vector = NDArray[np.float64]

# root mean square of the normals along a second direction, below which a surface is a plane
_CURVED = 0.1
# largest angle between axes that are meant to be one
_ONE_AXIS = 0.05
# affine part of the tilts, relative to the rest, above which they are a slope or a crown: where
# the normals at a rim are those of facets on one side, it is 0.8
_SYSTEMATIC = 1.0
# angle between the estimate and a coordinate axis that is meant, in standard deviations
_SCATTER = 3.0
# steps of the fit of a round cylinder, and the distance of its nodes from it that is rounding,
# relative to the size of the surface
_GAUSS_NEWTON_STEPS, _ROUND = 12, 1e-11


def without_axial_tilt(
    comm: MPI.Intracomm, surfaces: Sequence[tuple[Vector, Vector, Vector]]
) -> list[Vector]:
    """Return the normals of surfaces, across the axes of those that are extrusions. Collective.

    Surfaces with about the same axis get the same one, that of all their normals: a shaft in two
    bearings is free along it as well.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    surfaces : sequence of (normals, places, areas)
        This rank's unit normals (k, 3), their places (k, 3) [m] and areas (k,) [m^2].

    Returns
    -------
    list of (k, 3) arrays
        Unit normals; those of other surfaces as they are.
    """
    products = [(n * area[:, None]).T @ n for n, _, area in surfaces]
    products = list(comm.allreduce(np.array(products).reshape(-1, 3, 3)))
    found = {
        k: _axis(comm, products[k], surfaces[k][1])
        for k in range(len(surfaces))
        if _is_extrusion(products[k])
    }
    extrusions = {k: axis for k, axis in found.items() if axis is not None}
    axes = np.array(list(extrusions.values())).reshape(-1, 3)
    alike = np.abs(axes @ axes.T) >= np.cos(_ONE_AXIS)
    group = connected_components(alike, directed=False)[1]
    normals = [n for n, _, _ in surfaces]
    for k, g in zip(extrusions, group, strict=True):
        # the axes of one group may point to either side
        axis = np.linalg.svd(axes[group == g])[2][0]
        n, places, area = surfaces[k]
        if _is_scatter(comm, n @ axis, places, area):
            across = n - np.outer(n @ axis, axis)
            normals[k] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return normals


def _axis(comm: MPI.Intracomm, products: Vector, places: Vector) -> Vector | None:
    """Return the direction across which the normals are, if it is known to rounding.

    A load across it must do no work along it. The normals tell it up to their scatter over the
    root of their number. The nodes of a round cylinder, which are on it, tell its axis; of other
    surfaces it is the coordinate axis that is that near.
    """
    squares, directions = np.linalg.eigh(products)
    number = comm.allreduce(len(places))
    round_axis = _round_axis(comm, directions, places, number)
    if round_axis is not None:
        return round_axis
    nearest = np.argmax(np.abs(directions[:, 0]))
    axis: Vector = np.eye(3)[nearest] * np.sign(directions[nearest, 0])
    scatter = np.sqrt(max(squares[0], 0.0) / squares[1] / number)
    return axis if np.linalg.norm(axis - directions[:, 0]) <= _SCATTER * scatter else None


def _round_axis(
    comm: MPI.Intracomm, directions: Vector, places: Vector, number: int
) -> Vector | None:
    """Return the axis of a round cylinder, near the first direction; None if it is none."""
    middle = comm.allreduce(places.sum(axis=0)) / number
    size = comm.allreduce(float(np.abs(places - middle).max(initial=0.0)), MPI.MAX)
    # coordinates along the axis first; Gauss-Newton for its slopes, its place and the radius
    x = (places - middle) @ directions / size
    slopes, centre, radius = np.zeros(2), np.zeros(2), 0.0
    for _ in range(_GAUSS_NEWTON_STEPS):
        unit = np.array([1.0, *slopes])
        unit /= np.linalg.norm(unit)
        across = x - np.append(0.0, centre)
        height = across @ unit
        across = across - np.outer(height, unit)
        distance = np.linalg.norm(across, axis=1)
        outward = across / np.where(distance > 0.0, distance, 1.0)[:, None]
        moved = outward[:, 1:]
        rows = np.column_stack([-height[:, None] * moved, -moved, -np.ones(len(x))])
        misfit = distance - radius
        largest = comm.allreduce(float(np.abs(misfit).max(initial=0.0)), MPI.MAX)
        if largest <= _ROUND:
            axis: Vector = directions @ unit
            return axis
        gram, right = comm.allreduce(rows.T @ rows), comm.allreduce(rows.T @ misfit)
        step = -np.linalg.lstsq(gram, right, rcond=None)[0]
        slopes, centre, radius = slopes + step[:2], centre + step[2:4], radius + step[4]
    return None


def _is_extrusion(products: Vector) -> bool:
    """Tell whether normals, of which these are the mean products, are across one direction only."""
    area = np.trace(products)
    if area <= 0.0:
        return False
    least, second, _ = np.sqrt(np.maximum(np.linalg.eigvalsh(products), 0.0) / area)
    return bool(least <= AXIAL_TILT and second >= _CURVED)


def _is_scatter(comm: MPI.Intracomm, tilt: Vector, places: Vector, area: Vector) -> bool:
    """Tell whether tilts are more than rounding, and no affine function of the place."""
    total, centre = comm.allreduce(area.sum()), comm.allreduce(area @ places)
    size = comm.allreduce(float(np.abs(places).max(initial=0.0)), MPI.MAX)
    affine = np.column_stack([np.ones_like(tilt), (places - centre / total) / size])
    columns = np.column_stack([affine, tilt]) * np.sqrt(area / total)[:, None]
    gram = comm.allreduce(columns.T @ columns)
    square = float(gram[-1, -1])
    # the surface may be a plane: coordinates that depend on others
    fitted = float(gram[:-1, -1] @ np.linalg.pinv(gram[:-1, :-1], hermitian=True) @ gram[:-1, -1])
    rest = max(square - fitted, 0.0)
    return np.sqrt(square) > COORDINATE_ROUNDING and fitted <= _SYSTEMATIC**2 * rest
