"""Balls |y| <= r around the origin, block by block: intervals of one component, discs of two.

Friction forces y (k, d) and their bounds r (k,) are such blocks, and slips are vectors beside them.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.typing import Mask, Vector

# relative distance within which a point counts as on the boundary
_AT_BOUNDARY = 1e-9


def directions(y: Vector) -> Vector:
    """Return the unit vectors y / |y|, (k, d); zero where y is."""
    length = np.linalg.norm(y, axis=1, keepdims=True)
    return np.divide(y, length, out=np.zeros_like(y), where=length > 0.0)


def tangents(direction: Vector) -> Vector:
    """Return the vectors (k, 2) turned by a right angle: tangents of circles."""
    return np.column_stack([-direction[:, 1], direction[:, 0]])


def project(y: Vector, radius: Vector) -> Vector:
    """Return the nearest points (k, d) of the balls."""
    length = np.linalg.norm(y, axis=1)
    factor = np.divide(radius, length, out=np.ones_like(length), where=length > radius)
    return factor[:, None] * y


def inside(y: Vector, radius: Vector) -> Mask:
    """Tell which points are inside of their ball by more than rounding, (k,)."""
    return np.linalg.norm(y, axis=1) < (1.0 - _AT_BOUNDARY) * radius


def on_boundary(y: Vector, radius: Vector, where: Mask) -> Vector:
    """Return y with some blocks scaled to the length r; zeros stay."""
    return np.where(where[:, None], radius[:, None] * directions(y), y)


def misalignment(v: Vector, direction: Vector) -> Vector:
    """Return |v| - v'l (k,) for unit vectors l, both (k, d)."""
    size, along = np.linalg.norm(v, axis=1), np.sum(v * direction, axis=1)
    # without the difference where v is almost along l
    across = np.linalg.norm(v - along[:, None] * direction, axis=1)
    ahead = along > 0.0
    quotient = np.divide(across**2, size + along, out=np.zeros_like(size), where=ahead)
    return np.where(ahead, quotient, size - along)


def curvature(y: Vector, v: Vector, radius: Vector) -> Vector:
    """Return the second derivative v'y / (|y| r) of -v'y (k,) where y turns on its circle.

    It is zero where v is against y, and where r = 0.
    """
    along = np.maximum(np.sum(v * directions(y), axis=1), 0.0)
    return np.divide(along, radius, out=np.zeros_like(radius), where=radius > 0.0)


def longest_steps(quadratic: Vector, linear: Vector, room: Vector) -> Vector:
    """Return the ends (k,) of the a >= 0 from 0 on with q a^2 - 2 l a <= room.

    With q = |v|^2, l = y'v and room = r^2 - |y|^2 they are those with |y - a v| <= r.
    """
    room = np.maximum(room, 0.0)
    square = linear**2 + quadratic * room
    root, inwards = np.sqrt(np.maximum(square, 0.0)), linear > 0.0
    # the smallest positive root, without cancellation for either sign of l
    far = np.divide(
        linear + root, quadratic, out=np.full_like(root, np.inf), where=inwards & (quadratic > 0.0)
    )
    near = np.divide(room, root - linear, out=np.zeros_like(root), where=~inwards & (root > linear))
    never = (quadratic <= 0.0) & ((linear == 0.0) | (square < 0.0))
    return np.where(never, np.inf, np.where(inwards, far, near))
