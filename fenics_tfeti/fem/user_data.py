"""Values of the user's functions at points, checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.errors import InputError, format_point

__all__ = ["called", "first_place", "points_of", "unit_vectors", "vectors_at"]

Vector = NDArray[np.float64]

# a vector shorter than this part of the longest one has no direction but rounding's
_NO_DIRECTION = 1e-12


def called(function: Callable[[Vector], Any], points: Vector, what: str) -> Any:
    """Call a user's function at points (k, 3); what it raises becomes an `InputError`.

    Parameters
    ----------
    function : callable
        Called with points of shape (3, k).
    points : (k, 3) array
        [m].
    what : str
        The function's name in messages.

    Returns
    -------
    object
        What the function returned.
    """
    try:
        return function(np.array(points.T, order="C"))
    except InputError as error:
        raise InputError(f"{what}: {error}") from error
    except Exception as error:
        raise InputError(
            f"{what} failed for points of shape (3, {len(points)}): {type(error).__name__}: {error}"
        ) from error


def vectors_at(
    function: Callable[[Vector], ArrayLike], points: Vector, gdim: int, what: str
) -> Vector:
    """Return a user's vectors (k, gdim) at points (k, 3).

    Raises
    ------
    InputError
        A wrong shape, NaN, or what the function itself raises.
    """
    k = len(points)
    if k == 0:
        return np.zeros((0, gdim))
    values = _numbers(called(function, points, what), what)
    if values.shape not in ((gdim, k), (3, k)):
        raise InputError(
            f"{what} returned shape {values.shape} for points of shape (3, {k}), expected "
            f"({gdim}, {k})"
        )
    vectors = values[:gdim].T
    _check_finite(vectors, points, what)
    return vectors


def unit_vectors(
    given: ArrayLike | Callable[[Vector], ArrayLike], points: Vector, gdim: int, what: str
) -> Vector:
    """Return a constant or a user's function as unit vectors (k, gdim) at points (k, 3).

    Raises
    ------
    InputError
        A wrong shape, NaN, a vector without direction.
    """
    if callable(given):
        vectors = vectors_at(given, points, gdim, what)
    else:
        constant = _numbers(given, what)
        if constant.shape != (gdim,):
            raise InputError(
                f"{what} has shape {constant.shape}; expected ({gdim},) or a function of x"
            )
        if not np.isfinite(constant).all() or not np.any(constant):
            raise InputError(f"{what} is {constant.tolist()}: it has no direction")
        vectors = np.tile(constant, (len(points), 1))
    length = np.linalg.norm(vectors, axis=1)
    vanishing = length <= _NO_DIRECTION * length.max(initial=0.0)
    if vanishing.any():
        raise InputError(
            f"{what} vanishes at {np.count_nonzero(vanishing)} points, the first at "
            f"{first_place(points, vanishing, gdim)}: give a direction at every node of the slave"
        )
    unit: Vector = vectors / length[:, None]
    return unit


def points_of(given: ArrayLike, gdim: int, what: str) -> Vector:
    """Return points of shape (k, gdim), given with gdim or three coordinates each.

    Raises
    ------
    InputError
        A wrong shape or NaN.
    """
    points = _numbers(given, what)
    if points.ndim != 2 or points.shape[1] not in (gdim, 3) or not len(points):
        raise InputError(f"{what} have shape {points.shape}, expected (k, {gdim}) with k > 0")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(f"{what} are NaN or infinite, the first in row {row}")
    flat: Vector = points[:, :gdim]
    return flat


def _numbers(given: Any, what: str) -> Vector:
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected an array of numbers, not {type(given).__name__}") from (
            None
        )


def _check_finite(vectors: Vector, points: Vector, what: str) -> None:
    wrong = ~np.isfinite(vectors).all(axis=1)
    if wrong.any():
        raise InputError(
            f"{what} is NaN or infinite at {np.count_nonzero(wrong)} points, the first at "
            f"{first_place(points, wrong, vectors.shape[1])}"
        )


def first_place(points: Vector, wrong: NDArray[np.bool_], gdim: int) -> str:
    """Write the first of some points (k, 3), by their coordinates."""
    some = points[wrong][:, :gdim]
    size = float(np.abs(points).max(initial=0.0))
    return format_point(some[np.lexsort(some.T[::-1])[0]], size)
