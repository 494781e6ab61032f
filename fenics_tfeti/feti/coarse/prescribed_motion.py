"""The rigid motions that supports prescribe, taken out of the right-hand sides.

A body may be moved much farther than it deforms. With c = B R a + c' the problem for c' has the
same multipliers, and the displacement u' + R a: what rounding leaves of R a is then no part of the
jumps that the iterations close, of this body or of others.
"""

from __future__ import annotations

import numpy as np

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Vector

# size of a rigid motion relative to the prescribed displacements: larger ones come from rows that
# hardly resist them
_LARGEST = 10.0


def prescribed_motion(coarse_space: CoarseSpace, c: Vector) -> Vector:
    """Return the coarse vector of the rigid motions next to the prescribed ones. Collective.

    The vector a (coarse,) satisfies B_E R a = c_E in the least squares sense; it is zero where
    nothing is prescribed, or where R a would be out of proportion to it. Only the equality rows of
    c (m,) are used.
    """
    constraints, comm = coarse_space.constraints, coarse_space.comm
    prescribed = np.where(constraints.equality, c, 0.0)
    rows = np.flatnonzero(prescribed)
    entries, largest = constraints.matrix[rows].tocoo(), np.zeros(rows.size)
    np.maximum.at(largest, entries.row, np.abs(entries.data))
    given = np.abs(prescribed[rows])
    sizes = np.divide(given, largest, out=np.zeros(rows.size), where=largest > 0.0)
    size = largest_of_ranks(comm, sizes)
    none = np.zeros(coarse_space.size)
    if size == 0.0:
        return none
    supports = Projector.build(coarse_space, np.zeros(constraints.inequality.size, dtype=bool))
    a = supports.coefficients(prescribed)
    moved = largest_of_ranks(comm, np.abs(coarse_space.rigid_motion(a)))
    return a if moved <= _LARGEST * size else none
