"""The last faces, kept so that one that comes back is not factored again.

The feasible start, the scale of the energy, the first steps of the active set method and the
recovery of the displacement use the same two or three faces in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from mpi4py import MPI

import numpy as np

from fenics_tfeti.typing import Mask, Vector

T = TypeVar("T")

# a factor takes as much memory as dozens of multipliers
_KEPT = 2


@dataclass(frozen=True)
class RecentFaces(Generic[T]):
    """What belongs to the last faces, the latest one first.

    Attributes
    ----------
    comm : MPI.Intracomm
        The ranks; each of them has its rows of a face.
    kept : list of (rows, across, T)
        Rows and combinations of rows, see `Projector`, and what belongs to them.
    """

    comm: MPI.Intracomm
    kept: list[tuple[Mask, Vector | None, T]] = field(default_factory=list)

    def find(self, rows: Mask, across: Vector | None) -> T | None:
        """Return what was kept of a face, or None, on all ranks alike. Collective."""
        same = np.zeros(_KEPT, dtype=np.int32)
        for i, (other_rows, other_across, _) in enumerate(self.kept):
            same[i] = np.array_equal(rows, other_rows) and _same_across(across, other_across)
        if self.kept:
            self.comm.Allreduce(MPI.IN_PLACE, same, MPI.LAND)
        if not same.any():
            return None
        self.kept.insert(0, self.kept.pop(int(same.argmax())))
        return self.kept[0][2]

    def keep(self, rows: Mask, across: Vector | None, belonging: T) -> None:
        """Keep what belongs to a face in place of that of the oldest one."""
        self.kept.insert(0, (rows, across, belonging))
        del self.kept[_KEPT:]


def _same_across(one: Vector | None, other: Vector | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other)
