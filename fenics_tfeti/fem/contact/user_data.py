"""Values of the user's functions at points, checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.parallel import concatenate_ranks, raise_collectively

__all__ = ["called", "points_of", "refuse_where", "unit_vectors", "vectors_at"]

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
    comm: MPI.Intracomm,
    function: Callable[[Vector], ArrayLike],
    points: Vector,
    gdim: int,
    what: str,
) -> Vector:
    """Return a user's vectors (k, gdim) at points (k, 3). Collective.

    Raises
    ------
    InputError
        A wrong shape, NaN, or what the function itself raises.
    """
    with raise_collectively(comm):
        vectors = _vectors(function, points, gdim, what)
    refuse_where(
        comm,
        ~np.isfinite(vectors).all(axis=1),
        points[:, :gdim],
        lambda number, place: f"{what} is NaN or infinite at {number} points, the first at {place}",
    )
    return vectors


def unit_vectors(
    comm: MPI.Intracomm,
    given: ArrayLike | Callable[[Vector], ArrayLike],
    points: Vector,
    gdim: int,
    what: str,
) -> Vector:
    """Return a constant or a user's function as unit vectors (k, gdim) at points (k, 3).

    Collective.

    Raises
    ------
    InputError
        A wrong shape, NaN, a vector without direction.
    """
    if callable(given):
        vectors = vectors_at(comm, given, points, gdim, what)
    else:
        with raise_collectively(comm):
            vectors = np.tile(_direction(given, gdim, what), (len(points), 1))
    length = np.linalg.norm(vectors, axis=1)
    longest = comm.allreduce(float(length.max(initial=0.0)), MPI.MAX)
    refuse_where(
        comm,
        length <= _NO_DIRECTION * longest,
        points[:, :gdim],
        lambda number, place: (
            f"{what} vanishes at {number} points, the first at {place}: give a direction at every "
            "node of the slave"
        ),
    )
    unit: Vector = vectors / length[:, None]
    return unit


def refuse_where(
    comm: MPI.Intracomm,
    wrong: NDArray[np.bool_],
    points: Vector,
    message: Callable[[int, str], str],
) -> None:
    """Raise an `InputError` on all ranks if something is wrong at some points of some ranks.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    wrong : (k,) bool array
        Whether it is wrong at this rank's points.
    points : (k, gdim) array
        [m].
    message : callable
        (number of wrong points, the first of them by its coordinates) -> message.
    """
    found = concatenate_ranks(comm, points[wrong])
    size = comm.allreduce(float(np.abs(points).max(initial=0.0)), MPI.MAX)
    if len(found):
        first = found[np.lexsort(found.T[::-1])[0]]
        raise InputError(message(len(found), format_point(first, size)))


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


def _vectors(
    function: Callable[[Vector], ArrayLike], points: Vector, gdim: int, what: str
) -> Vector:
    k = len(points)
    if k == 0:  # a user's function need not be prepared for that
        return np.zeros((0, gdim))
    values = _numbers(called(function, points, what), what)
    if values.shape not in ((gdim, k), (3, k)):
        raise InputError(
            f"{what} returned shape {values.shape} for points of shape (3, {k}), expected "
            f"({gdim}, {k})"
        )
    vectors: Vector = values[:gdim].T
    return vectors


def _direction(given: ArrayLike, gdim: int, what: str) -> Vector:
    constant = _numbers(given, what)
    if constant.shape != (gdim,):
        raise InputError(
            f"{what} has shape {constant.shape}; expected ({gdim},) or a function of x"
        )
    if not np.isfinite(constant).all() or not np.any(constant):
        raise InputError(f"{what} is {constant.tolist()}: it has no direction")
    return constant
