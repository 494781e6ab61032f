"""Error messages that name the first place where something is wrong, for any number of ranks."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.mesh import Mesh

from fenics_tfeti.errors import format_point
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


def coordinate_order(points: Vector) -> NDArray[np.intp]:
    """Return the order of points (k, gdim) by coordinates, which is that on any ranks.

    Coordinates that differ by rounding are the same, and the next ones decide.
    """
    size = np.abs(points).max(initial=0.0) or 1.0
    return np.lexsort(np.round(points / (RELATIVE_ROUNDING * size)).T[::-1])


def first_rows(comm: MPI.Intracomm, columns: Sequence[Vector], number: int) -> list[Vector]:
    """Return the first rows of all ranks by the coordinates in the first column. Collective."""

    def first(rows: Sequence[Vector]) -> list[Vector]:
        order = coordinate_order(rows[0])[:number]
        return [row[order] for row in rows]

    # sorted on each rank as well, so that each sends few rows
    return first([concatenate_ranks(comm, row) for row in first(columns)])


def first_distances(
    comm: MPI.Intracomm, points: Vector, distance: Vector, limit: Vector, size: float = 0.0
) -> str:
    """Write the first points of all ranks that are too far away, and how far. Collective."""
    return "; ".join(
        format_point(point, size)
        + (f" at distance {length:.3g} (tolerance {bound:.3g})" if isfinite(length) else "")
        for point, length, bound in zip(
            *first_rows(comm, (points, distance, limit), 3), strict=True
        )
    )


class WrongPoints(NamedTuple):
    """How many points of all ranks are wrong, and the coordinates of the first one as text."""

    number: int
    place: str
    contact: int  # the first contact that has any; those of others are not counted
    name: str  # of the contact


def first_wrong(
    comm: MPI.Intracomm,
    wrong: Mask,
    points: Vector,
    contact: Numbers | None = None,
    names: Sequence[str] = ("",),
) -> WrongPoints | None:
    """Return what is wrong at points (k, gdim) [m] of all ranks, of the first such contact (k,)."""
    of_points = np.zeros(len(points), dtype=np.int64) if contact is None else contact
    bad = concatenate_ranks(comm, np.column_stack([of_points, points])[wrong])
    if not len(bad):
        return None
    first = int(bad[:, 0].min())
    bad = bad[bad[:, 0] == first, 1:]
    size = float(np.abs(points[of_points == first]).max(initial=0.0))
    size = comm.allreduce(size, MPI.MAX)
    place = format_point(bad[coordinate_order(bad)[0]], size)
    return WrongPoints(len(bad), place, first, names[first])


def first_mesh_point(domain: Mesh, points: Vector) -> str:
    """Write the first of points (k, gdim) with the digits that the mesh leaves. Collective."""
    size = float(np.abs(domain.geometry.x).max(initial=0.0))
    first = points[coordinate_order(points)[0]]
    return format_point(first, domain.comm.allreduce(size, MPI.MAX))
