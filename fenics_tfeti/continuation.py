"""The checkpoint of a contact problem: load steps and geometry passes beside the multipliers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.deformed import GeometryPass
from fenics_tfeti.fem.contact.slip import SlipOrigin
from fenics_tfeti.feti import SavedState, TornSystem, load_checkpoint, save_checkpoint
from fenics_tfeti.parallel import raise_collectively

__all__ = ["Continuation", "read_continuation", "write_continuation"]

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Continuation:
    """Where a later run of the same script goes on.

    Attributes
    ----------
    state : SavedState
        Start of the iterations.
    displacement : (n,) array
        The last displacement at the degrees of freedom that this rank owns [m].
    solves : int
        Finished calls of `solve`.
    origin : SlipOrigin
        From where friction counts slip.
    passes : list of GeometryPass
        The finished passes of the call that was not.
    """

    state: SavedState
    displacement: Vector
    solves: int
    origin: SlipOrigin
    passes: Sequence[GeometryPass] = ()


def write_continuation(
    path: str | os.PathLike[str], system: TornSystem, continuation: Continuation
) -> None:
    """Write a checkpoint, or leave the old one as it is. Collective; rank 0 writes.

    Raises
    ------
    OSError
        On all ranks, if rank 0 cannot write the file.
    """
    rows = np.array([astuple(p) for p in continuation.passes])
    save_checkpoint(
        path,
        system,
        continuation.state,
        own={
            "displacement": continuation.displacement,
            "slip_origin": continuation.origin.displacement,
            "slip_origin_obstacles": continuation.origin.obstacles.ravel(),
        },
        common={
            "solves": np.array(continuation.solves),
            "passes": rows.reshape(-1, len(fields(GeometryPass))),
        },
    )


def read_continuation(
    path: str | os.PathLike[str], system: TornSystem, size: int, contacts: int
) -> Continuation:
    """Read the part of this rank from a checkpoint. Collective.

    Parameters
    ----------
    path : path-like
        The file.
    system : TornSystem
        The problem.
    size : int
        Number of degrees of freedom that this rank owns.
    contacts : int
        Number of contacts.

    Raises
    ------
    InputError
        On all ranks, if the file is not a checkpoint of this problem, or damaged.
    OSError
        On all ranks, if the file cannot be read.
    """
    found = load_checkpoint(path, system)
    own, common = found.own, found.common
    with raise_collectively(system.comm):
        # a checkpoint of a torn system has none of these
        displacement, slip_origin, obstacles = (
            own.get(name, np.zeros(0))
            for name in ("displacement", "slip_origin", "slip_origin_obstacles")
        )
        passes = common.get("passes", np.zeros(0))
        columns = len(fields(GeometryPass))
        numbers = displacement, slip_origin, obstacles, passes
        shapes = (size,), (size,), (contacts * size,), (len(passes), columns)
        if tuple(x.shape for x in numbers) != shapes or any(x.dtype.kind != "f" for x in numbers):
            raise InputError(f"{path}: the checkpoint is not one of a ContactProblem")
    finished = [GeometryPass(*row) for row in passes.tolist()]
    finished = [replace(one, products=int(one.products)) for one in finished]
    origin = SlipOrigin(slip_origin, obstacles.reshape(contacts, size))
    return Continuation(found.state, displacement, int(common["solves"]), origin, finished)
