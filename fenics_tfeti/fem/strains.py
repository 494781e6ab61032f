"""Check whether strains and rotations of a solution are as small as linear elasticity assumes."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.errors import warn_user
from fenics_tfeti.fem.decomposition.bodies import Bodies
from fenics_tfeti.fem.gradients import CellGradients
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Vector

# |grad u| from which on its square, which linear elasticity leaves out, is no small part of it
_LARGE = 0.1
# share of the strain energy that is more than that of corners and point loads
_SHARE = 0.1


def warn_of_large_gradients(uh: Function, bodies: Bodies, energy: Sequence[float]) -> bool:
    """Warn, on rank 0, if displacement gradients are large in cells that carry load. Collective.

    They are those at the midpoints. Bodies without strain energy [J] may turn as far as they like.
    Return on all ranks whether there was a warning.
    """
    comm = uh.function_space.mesh.comm
    size, strain2 = _cell_measures(uh)
    large = size > _LARGE
    sums, largest = np.zeros((2, len(energy))), np.zeros(len(energy))
    np.add.at(sums[0], bodies.of_cell, strain2)
    np.add.at(sums[1], bodies.of_cell[large], strain2[large])
    np.maximum.at(largest, bodies.of_cell, size)
    comm.Allreduce(MPI.IN_PLACE, sums)
    comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    # the strain energy in large cells, as a share of that of all bodies
    share = np.divide(sums[1], sums[0], out=np.zeros_like(largest), where=sums[0] > 0.0)
    share *= np.asarray(energy) / max(sum(energy), np.finfo(float).tiny)
    if share.sum() <= _SHARE:
        return False
    worst = int(share.argmax())
    with raise_collectively(comm):
        if comm.rank == 0:
            warn_user(
                f"|grad u| is as large as {largest[worst]:.2g} in {bodies.names[worst]}, and above "
                f"{_LARGE:g} in cells with {share.sum():.0%} of the strain energy; linear "
                "elasticity and the contact conditions are right for |grad u| much smaller than 1 "
                "only. Do the units fit, such as E in Pa with lengths in m, or in MPa with mm?"
            )
    return True


def _cell_measures(uh: Function) -> tuple[Vector, Vector]:
    """Return |grad u| and |strain|^2 times the volume of the cells that this rank owns."""
    space = uh.function_space
    u = uh.x.array.reshape(-1, space.dofmap.index_map_bs)
    size, strain2 = [np.zeros(0)], [np.zeros(0)]
    for batch in CellGradients(space).at_midpoints(u):
        gradient = batch.fields[0][:, 0]
        strain = 0.5 * (gradient + gradient.transpose(0, 2, 1))
        size.append(np.linalg.norm(gradient, axis=(1, 2)))
        strain2.append(np.sum(strain**2, axis=(1, 2)) * batch.scale[:, 0])
    return np.concatenate(size), np.concatenate(strain2)
