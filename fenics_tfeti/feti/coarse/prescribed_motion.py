"""The rigid motions that supports and gaps prescribe, taken out of the right-hand sides.

A body may be moved much farther than it deforms. With c = B R a + c' the problem for c' has the
same multipliers, and the displacement u' + R a: what rounding leaves of R a is then no part of the
jumps that the iterations close, of this body or of others.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.tolerances import MANY, rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import ProductSet, bounded_springs
from fenics_tfeti.typing import Mask, Numbers, Vector

# size of a rigid motion relative to the prescribed displacements: larger ones come from rows that
# hardly resist them
_LARGEST = 10.0
# part of the gaps that a motion which closes them may leave: gaps between bodies that touch on all
# sides, such as grains, can not be closed, and would be spread over all of their contacts
_LEFT = 0.1


def prescribed_motion(coarse_space: CoarseSpace, c: Vector) -> Vector:
    """Return the coarse vector of the rigid motions next to the prescribed ones. Collective.

    The vector a (coarse,) satisfies B_E R a = c_E in the least squares sense; it is zero where
    nothing is prescribed, or where R a would be out of proportion to it. Only the equality rows of
    c (m,) are used.
    """
    constraints = coarse_space.constraints
    prescribed = np.where(constraints.equality, c, 0.0)
    size = _displacement(coarse_space, prescribed, np.flatnonzero(prescribed))
    if size == 0.0:
        return np.zeros(coarse_space.size)
    supports = Projector.build(coarse_space, Face.supports(constraints))
    return _in_proportion(coarse_space, supports.coefficients(prescribed), size)


def closing_motion(coarse_space: CoarseSpace, c: Vector, pressing: Mask) -> Vector:
    """Return the coarse vector of the motions that close the gaps of some contacts. Collective.

    Motions that supports leave free close the pressing contact rows (i,) in the least squares
    sense, or are zero where most of the gaps c would be left, or where they would be out of
    proportion to these.
    """
    constraints, free = coarse_space.constraints, coarse_space.resistance_of_supports().free
    owned = constraints.owned_contact_rows
    rows = np.intersect1d(constraints.inequality[pressing], owned)
    size = _displacement(coarse_space, c, rows)
    if size == 0.0 or not free.shape[1]:
        return np.zeros(coarse_space.size)
    closing = sp.diags(constraints.lengths_of_rows()[rows]) @ coarse_space.bodies.moved[rows]
    z = bounded_springs(
        closing.tocsr(),
        c[rows],
        ProductSet(),
        basis=free,
        sum_vectors=constraints.layout.space.sum_over_ranks,
        sum_matrices=partial(sum_sparse, coarse_space.comm),
    )
    gaps = [
        largest_of_ranks(coarse_space.comm, np.abs(g))
        for g in (c[rows], closing @ (free @ z) - c[rows])
    ]
    if gaps[1] > _LEFT * gaps[0]:
        return np.zeros(coarse_space.size)
    a = coarse_space.coarse_motions(free @ z)
    # bodies that do not move have a of rounding, which would count as a motion of theirs
    a[np.abs(a) <= rounding(np.abs(a).max(initial=0.0), MANY)] = 0.0
    return _in_proportion(coarse_space, a, size)


def without_motion(coarse_space: CoarseSpace, c: Vector, a: Vector) -> Vector:
    """Return c' = c - B R a, zero where it is rounding. Collective.

    What rounding of coordinates leaves of a gap or of a jump is none, however small the loads are.
    """
    constraints = coarse_space.constraints
    if not a.any():
        return c
    terms = abs(constraints.matrix) @ coarse_space.rigid_motion_size(a)
    left, size = c - coarse_space.prolong(a), np.abs(c) + constraints.layout.sum(terms)
    return np.where(np.abs(left) <= rounding(size, MANY), 0.0, left)


def _displacement(coarse_space: CoarseSpace, c: Vector, rows: Numbers) -> float:
    """Return the largest displacement that some rows of c prescribe [m]. Collective."""
    entries, largest = coarse_space.constraints.matrix[rows].tocoo(), np.zeros(rows.size)
    np.maximum.at(largest, entries.row, np.abs(entries.data))
    given = np.abs(c[rows])
    sizes = np.divide(given, largest, out=np.zeros(rows.size), where=largest > 0.0)
    return largest_of_ranks(coarse_space.comm, sizes)


def _in_proportion(coarse_space: CoarseSpace, a: Vector, size: float) -> Vector:
    """Return a, or zero where R a is out of proportion. Collective."""
    moved = largest_of_ranks(coarse_space.comm, np.abs(coarse_space.rigid_motion(a)))
    return a if moved <= _LARGEST * size else np.zeros(coarse_space.size)
