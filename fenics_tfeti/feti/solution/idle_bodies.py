"""Multipliers of groups of bodies that nothing loads.

Bodies that do not press on others decouple, and without a load the dual function of such a group is
-1/2 lambda'F lambda - c'lambda. Where c'lambda >= 0, as in a body that touches nothing, lambda = o
is at least as good. What the iterations leave there instead has no scale: relative to the energy of
the group, which is all error, it never becomes small.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.solution.certificate import RowBodies
from fenics_tfeti.typing import Vector


def without_idle_forces(
    constraints: Constraints,
    row_bodies: RowBodies,
    load: Vector,
    c: Vector,
    multipliers: Vector,
) -> Vector:
    """Return the multipliers with zeros in groups without a load where that is no worse.

    Collective.

    Parameters
    ----------
    constraints : Constraints
        B.
    row_bodies : RowBodies
        The bodies of subdomains and of rows.
    load : (n,) array
        f of this rank's subdomains [N].
    c : (m,) array
        Right-hand sides of the constraints.
    multipliers : (m,) array
        lambda, with G lambda = e.

    Returns
    -------
    (m,) array
        With G lambda = e.
    """
    comm, layout = constraints.layout.comm, constraints.layout
    friction = constraints.friction
    rubbing = friction.at_sites(multipliers).any(axis=1)
    group = row_bodies.groups(comm, multipliers[constraints.inequality] > 0.0, rubbing)
    matrix = constraints.matrix
    of_unknown = row_bodies.of_unknown
    held = np.flatnonzero(np.diff(matrix.indptr))
    # all bodies of a row with a force are of one group
    row_group = group[of_unknown[matrix.indices[matrix.indptr[held]]]]
    size = int(group.max(initial=-1)) + 1
    owned = held < layout.owned
    forced = np.bincount(group[of_unknown[load != 0.0]], minlength=size)
    work = np.bincount(row_group[owned], (c * multipliers)[held[owned]], size)
    sums = layout.space.sum_over_ranks(np.concatenate([forced, work])).reshape(2, size)
    idle = (sums[0] == 0.0) & (sums[1] >= 0.0)
    here = np.zeros(multipliers.size)
    here[held] = idle[row_group]
    result: Vector = np.where(layout.sum(here) > 0.0, 0.0, multipliers)
    return result
