"""A cache of the last faces, so that one that comes back is not factored again.

The feasible start, the scale of the energy, the first steps of the active set method and the
recovery of the displacement use the same two or three faces in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti.constraints.face import Face

# a factor takes as much memory as dozens of multipliers
_KEPT = 2


@dataclass(frozen=True)
class FaceCache:
    """The last faces, the latest one first."""

    comm: MPI.Intracomm
    kept: list[tuple[Face, Any]] = field(default_factory=list)

    def find(self, face: Face) -> Any:
        """Return what was kept for the rows of a face, or None, on all ranks alike. Collective."""
        same = np.zeros(_KEPT, dtype=np.int32)
        for i, (other, _) in enumerate(self.kept):
            same[i] = face.has_rows_of(other)
        if self.kept:
            self.comm.Allreduce(MPI.IN_PLACE, same, MPI.LAND)
        if not same.any():
            return None
        self.kept.insert(0, self.kept.pop(int(same.argmax())))
        return self.kept[0][1]

    def drop_oldest(self) -> None:
        """Make room for another one, before it is made."""
        del self.kept[_KEPT - 1 :]

    def keep(self, face: Face, belonging: Any) -> None:
        """Keep an object for a face."""
        self.kept.insert(0, (face, belonging))
        del self.kept[_KEPT:]
