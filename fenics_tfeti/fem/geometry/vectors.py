"""Vectors in arrays: lengths, angles, products, rotations."""

from __future__ import annotations

from functools import reduce

import numpy as np

from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING
from fenics_tfeti.typing import Vector


def unit(vectors: Vector) -> Vector:
    """Return unit vectors; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def edge_lengths(corners: Vector) -> Vector:
    """Return the lengths (m, v) of the edges from each corner (m, v, gdim) to the next."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def cross(u: Vector, w: Vector) -> Vector:
    """Return the cross products (..., 3), ten times as fast as NumPy's."""
    (a, b, c), (d, e, f) = (np.moveaxis(x, -1, 0) for x in (u, w))
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=-1)


def centres(x: Vector) -> Vector:
    """Return the mean (k, d) of x (k, v, d) over the corners, ten times as fast as NumPy's."""
    return np.einsum("kvd->kd", x) / x.shape[1]


def lowest(x: Vector) -> Vector:
    """Return the minimum (k, d) of x (k, v, d) over the corners; faster than NumPy's for few."""
    return reduce(np.minimum, np.moveaxis(x, 1, 0))


def highest(x: Vector) -> Vector:
    """Return the maximum (k, d) of x (k, v, d) over the corners."""
    return reduce(np.maximum, np.moveaxis(x, 1, 0))


def angles_between(first: Vector, second: Vector) -> Vector:
    """Return the angles between unit vectors (k, gdim), row by row [degrees]."""
    # by the chord, which is accurate for small angles, unlike the inverse cosine
    chord = np.linalg.norm(first - second, axis=1)
    chord[chord < COORDINATE_ROUNDING] = 0.0
    return np.degrees(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))


def tangential_part(vectors: Vector, normal: Vector) -> Vector:
    """Return vectors (..., gdim) less their components along unit normals (..., gdim)."""
    return vectors - np.sum(vectors * normal, axis=-1, keepdims=True) * normal


def nearest_rotation(H: Vector) -> Vector:
    """Return the rotations nearest to matrices (..., gdim, gdim), in the Frobenius norm.

    Of a plane set of points, which tells no stretch along its normal, it is the proper rotation.

    Examples
    --------
    >>> nearest_rotation(np.array([[0.0, -2.0], [0.0, 0.0]])).round(12).tolist()
    [[0.0, -1.0], [1.0, 0.0]]
    """
    left, _, right = np.linalg.svd(H)
    left[..., -1] *= np.linalg.det(left @ right)[..., None]
    return left @ right
