"""Values of the user's functions and arrays at points, checked.

Directions, mappings, normals, pairs of points and obstacles all come through here. The file belongs
to no sub-package: markers of facets in `io` are evaluated by it as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike

from dolfinx.fem import Function
from ufl.core.expr import Expr

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.messages import first_wrong
from fenics_tfeti.fem.tolerances import NO_DIRECTION
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# constants, or functions of points x (3, n) that return (n,) or (gdim, n)
ScalarField: TypeAlias = float | Callable[[Vector], ArrayLike]
VectorField: TypeAlias = ArrayLike | Callable[[Vector], ArrayLike]


def is_number(value: Any) -> bool:
    """Tell whether a value is one finite real number; a truth value is none."""
    if not isinstance(value, int | float | np.number | np.ndarray) or np.ndim(value):
        return False
    return np.asarray(value).dtype.kind in "iuf" and bool(np.isfinite(value))


def is_integer(value: Any) -> bool:
    """Tell whether a value is an integer; a truth value is none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def check_positive(value: Any, what: str, relative_to: str = "") -> None:
    """Check a positive number."""
    if not (is_number(value) and value > 0.0):
        more = f", relative to {relative_to}" if relative_to else ""
        raise InputError(f"{what} is {value!r}; a positive number is expected{more}")


def as_coordinates(values: Any, what: str) -> Vector:
    """Return two or three finite numbers as an array."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape not in ((2,), (3,)) or not np.isfinite(numbers).all():
        raise InputError(f"{what} is {values!r}: two or three finite numbers are expected")
    return numbers


def as_direction(values: Any, what: str) -> Vector:
    """Return a vector of two or three numbers as a unit vector."""
    vector = as_coordinates(values, what)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise InputError(f"{what} is {values!r}: it has no direction")
    return vector / length


def is_function(value: Any, what: str, or_else: str = "") -> bool:
    """Tell whether a value is a function of points x (3, n); refuse what UFL can call."""
    if isinstance(value, Expr):
        kind = "Function" if isinstance(value, Function) else "UFL expression"
        raise InputError(
            f"{what} is a {kind}, to which points x (3, n) cannot be given. Write it as a function "
            f"of x, such as lambda x: 0.2 + 0.01 * x[0]{or_else}"
        )
    return callable(value)


def check_field(
    field: Any, what: str, as_vector: Callable[[Any, str], Vector] = as_coordinates
) -> None:
    """Check a vector, unless it is a function or left out."""
    if not (field is None or is_function(field, what)):
        as_vector(field, what)


def evaluate(function: Callable[[Vector], Any], points: Vector, what: str) -> Any:
    """Call a user's function of points (3, k); what it raises becomes an `InputError`."""
    try:
        return function(np.array(points.T, order="C"))
    except InputError as error:
        raise InputError(f"{what}: {error}") from error
    except Exception as error:
        raise InputError(
            f"{what} failed for points of shape (3, {len(points)}): {type(error).__name__}: {error}"
        ) from error


def scalars_at(
    comm: MPI.Intracomm,
    values: ScalarField | Vector,
    points: Vector,
    gdim: int,
    what: str,
    lowest: float = -np.inf,
) -> Vector:
    """Return a user's scalar (k,) at points (k, 3), checked. Collective.

    It is a number, a function, or an array of values at the points. No value is below `lowest`.
    """
    with raise_collectively(comm):
        scalars = _called(values, points, what, (len(points),)) if callable(values) else values
    scalars = np.array(np.broadcast_to(scalars, len(points)), dtype=float)
    wrong = "NaN or infinite" if lowest == -np.inf else "negative, NaN or infinite"
    if bad := first_wrong(comm, ~(np.isfinite(scalars) & (scalars >= lowest)), points[:, :gdim]):
        raise InputError(f"{what} is {wrong} at {bad.number} points, the first at {bad.place}")
    return scalars


def vectors_at(
    comm: MPI.Intracomm, field: VectorField, points: Vector, gdim: int, what: str
) -> Vector:
    """Return a user's constant vector or vector field (k, gdim) at points (k, 3). Collective."""
    with raise_collectively(comm):
        vectors = _vectors(field, points, gdim, what)
    if bad := first_wrong(comm, ~np.isfinite(vectors).all(axis=1), points[:, :gdim]):
        raise InputError(
            f"{what} is NaN or infinite at {bad.number} points, the first at {bad.place}"
        )
    return vectors


def unit_vectors(
    comm: MPI.Intracomm, direction: VectorField, points: Vector, gdim: int, what: str
) -> Vector:
    """Return `vectors_at` divided by their lengths. Collective."""
    vectors = vectors_at(comm, direction, points, gdim, what)
    length = np.linalg.norm(vectors, axis=1)
    longest = comm.allreduce(float(length.max(initial=0.0)), MPI.MAX)
    if bad := first_wrong(comm, length <= NO_DIRECTION * longest, points[:, :gdim]):
        raise InputError(
            f"{what} vanishes at {bad.number} points, the first at {bad.place}: give a non-zero "
            "vector at every node of the slave"
        )
    return vectors / length[:, None]


def as_points(data: ArrayLike, what: str) -> Vector:
    """Return a user's points as an array, with two or three coordinates each."""
    points = as_array(data, what)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
        raise InputError(f"{what} have shape {points.shape}, expected (k, 2) or (k, 3) with k > 0")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(f"{what} are NaN or infinite, the first in row {row}")
    return points


def as_array(data: Any, what: str) -> Vector:
    """Return a user's numbers as an array."""
    try:
        return np.asarray(data, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected an array of numbers, not {type(data).__name__}") from (
            None
        )


def _vectors(field: VectorField, points: Vector, gdim: int, what: str) -> Vector:
    k = len(points)
    if callable(field):
        values = _called(field, points, what, (gdim, k), (3, k))
        return values[:gdim].T
    vector = as_array(field, what)
    if vector.shape != (gdim,):
        raise InputError(f"{what} has shape {vector.shape}, expected ({gdim},) or a function of x")
    return np.tile(vector, (k, 1))


def _called(
    function: Callable[[Vector], ArrayLike], points: Vector, what: str, *shapes: tuple[int, ...]
) -> Vector:
    """Return the values of a user's function, of one of some shapes, as a rule the first."""
    if not len(points):  # a user's function may fail for no points
        return np.zeros(shapes[0])
    values = as_array(evaluate(function, points, what), what)
    if values.shape not in shapes:
        raise InputError(
            f"{what} returned shape {values.shape} for points of shape (3, {len(points)}), "
            f"expected {shapes[0]}"
        )
    return values
