"""Checkpoints: where a later run of the same problem may start, in a file.

A checkpoint holds the multipliers, with the numbers of their rows. It is a start, not a result:
whatever it contains, the certificate decides when the iterations end.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.dual.iterate import Iterate
from fenics_tfeti.feti.files.arrays import open_arrays, write_arrays
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Numbers, Vector

_FORMAT = "fenics_tfeti checkpoint 4"
# what each rank writes of its state, and the kinds of the arrays
_ARRAYS = {
    "multipliers": "numbers",
    "numbers": "integers",
    "contact_rows": "integers",
    "tied_rows": "integers",
}


@dataclass(frozen=True)
class SavedState:
    """An iterate of the dual problem on this rank, with the rows that it belongs to.

    Attributes
    ----------
    multipliers : (m,) array
        lambda; the active set is where those of contact rows are positive.
    numbers : (m,) integer array
        Global numbers of the rows.
    contact_rows, tied_rows : integer arrays
        Local position of each contact row and tied row that this rank gave.
    direct_faces : bool
        Whether faces are solved directly from here on, since conjugate gradients were slow; the
        same on all ranks.
    """

    multipliers: Vector
    numbers: Numbers
    contact_rows: Numbers
    tied_rows: Numbers
    direct_faces: bool = False

    @staticmethod
    def of(iterate: Iterate, constraints: Constraints) -> SavedState:
        """Return an iterate with the numbers of its rows."""
        return SavedState(
            iterate.multipliers,
            constraints.layout.numbers,
            constraints.contacts.own_rows,
            constraints.tied.own_rows,
            iterate.is_direct,
        )

    def for_rows(self, constraints: Constraints) -> Iterate | None:
        """Return the iterate for rows that are numbered alike on all ranks, or None. Collective."""
        pairs = (
            (self.numbers, constraints.layout.numbers),
            (self.contact_rows, constraints.contacts.own_rows),
            (self.tied_rows, constraints.tied.own_rows),
        )
        same = all(np.array_equal(*pair) for pair in pairs)
        if not constraints.layout.comm.allreduce(same, MPI.LAND):
            return None
        return Iterate(self.multipliers.copy(), is_direct=self.direct_faces)


def fingerprint(system: TornSystem) -> dict[str, str]:
    """Return what a checkpoint has to agree in with a problem, as check sums. Collective.

    They are of the "subdomains" (node numbers, coordinates, bodies), the "supports" (nodes and
    components), the "contacts" (nodes, friction) and "tied surfaces" (nodes), over all ranks.
    Loads, prescribed values, gaps and stiffness may differ: load steps change them.
    """
    parts: dict[str, list[Any]] = {
        "subdomains": [(s.nodes, s.coordinates, s.body) for s in system.subdomains],
        "supports": [(system.prescribed.nodes, system.prescribed.components)],
        "contacts": [
            (
                system.contacts.offsets,
                system.contacts.nodes,
                system.contacts.contact,
                system.friction.row,
            )
        ],
        "tied surfaces": [(system.tied.offsets, system.tied.nodes, system.tied.contact)],
    }
    local_sums = {name: _check_sum(part) for name, part in parts.items()}
    gathered = system.comm.allgather(local_sums)
    return {name: _check_sum([tuple(rank[name] for rank in gathered)]) for name in parts}


def _check_sum(parts: list[Any]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        for values in part:
            array = np.ascontiguousarray(values)
            digest.update(f"{array.dtype.str} {array.shape} ".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()


def save_checkpoint(path: str | os.PathLike[str], system: TornSystem, state: SavedState) -> None:
    """Write a checkpoint, or leave the old one as it is. Collective; rank 0 writes.

    Parameters
    ----------
    path : path-like
        File to write or replace.
    system : TornSystem
        The problem.
    state : SavedState
        Where a later run starts.

    Raises
    ------
    OSError
        On all ranks, if rank 0 cannot write the file.
    """
    comm, sums = system.comm, fingerprint(system)
    parts = comm.gather(vars(state))
    with raise_collectively(comm):
        if parts is not None:
            arrays = {
                "ranks": np.array(comm.size),
                "direct_faces": np.array(int(state.direct_faces)),
            }
            arrays |= {f"fingerprint/{name}": np.array(text) for name, text in sums.items()}
            for rank, part in enumerate(parts):
                arrays |= {f"{rank}/{name}": part[name] for name in _ARRAYS}
            write_arrays(path, "the checkpoint", _FORMAT, arrays)


def load_checkpoint(path: str | os.PathLike[str], system: TornSystem) -> SavedState:
    """Read the part of this rank from a checkpoint. Collective.

    Parameters
    ----------
    path : path-like
        The file.
    system : TornSystem
        The problem, on as many ranks as the one that was saved.

    Raises
    ------
    InputError
        On all ranks, if the file is no checkpoint, damaged, or that of another problem or of
        another distribution of its mesh.
    OSError
        On all ranks, if the file cannot be read.
    """
    comm, sums = system.comm, fingerprint(system)
    with raise_collectively(comm), open_arrays(path, _FORMAT) as file:
        ranks = file.integer("ranks")
        if ranks != comm.size:
            raise InputError(
                f"{path}: the checkpoint is of a run on {ranks} ranks, this one has {comm.size}. "
                "Continue on as many ranks, or start anew"
            )
        for name, text in sums.items():
            if str(file.read(f"fingerprint/{name}", "strings", ())) != text:
                raise InputError(
                    f"{path}: the checkpoint is that of another problem, or of another "
                    f"distribution of its mesh: the {name} differ"
                )
        prefix = f"{comm.rank}/"
        arrays = {name: file.read(prefix + name, kind, (None,)) for name, kind in _ARRAYS.items()}
        if arrays["multipliers"].size != arrays["numbers"].size:
            raise InputError(f"{path}: the multipliers and the numbers of their rows do not fit")
        state = SavedState(**arrays, direct_faces=bool(file.integer("direct_faces")))
    return state
