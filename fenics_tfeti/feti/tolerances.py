"""Relative sizes that mean the same in the whole layer, each with what it is relative to.

Parameters of a single algorithm stand where it is implemented.

Sensitivity on 300 random problems of tests/fuzz, one rank: no outcome changes if `ZERO`, `WEAK`,
`SURFACE` and `SOFT_SUPPORT` are twice as large, all at once, or half as large, nor if the numbers
of rounding errors, `HARDLY_DEFORMED` and `UNDEFORMED` are. All products together change by about
1 % at most. What is known of a single constant is said beside it.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from fenics_tfeti.typing import Vector

T = TypeVar("T", float, Vector)

# numbers of rounding errors for `rounding`: those in the energy of a rigid mode, whose terms cancel
# but for their own rounding (at 16 a spring of 3e-12 of the stiffness is no support, and contact
# forces were wrong), those of a few operations on given numbers and of sums over a node, those of
# sums over a body and of solutions of systems, and those that a user's program may have made before
ENERGY, FEW, MANY, GIVEN = 8, 32, 512, 4096


def rounding(size: T, n: int = 1) -> T:
    """Return the size of n rounding errors of numbers of a size in double precision.

    The number n is 1, `ENERGY`, `FEW`, `MANY` or `GIVEN`.

    Examples
    --------
    >>> rounding(1.0), rounding(8.0, FEW)
    (2.220446049250313e-16, 5.684341886080802e-14)
    """
    return size * (n * float(np.finfo(float).eps))


# -- thresholds of rank, work and resistance -------------------------------------------------------

# relative size treated as zero: in the rank of matrices whose rows or columns have length 1, in the
# work of loads relative to force times displacement, and in closing speeds
ZERO = 1e-9
# resistance ||B R xi|| of rows of B to rigid motions of a root mean square displacement of 1,
# `coarse.resistance.Resistance`. Up to ZERO they leave a motion free.
# GG', which squares it, does not show what is weaker than this, half the digits: such motions are
# pinned in the factor of GG' and corrected. At half of it no problem takes another number of
# products
WEAK = 1e-4
# what is less is only the tilt of normals on faceted surfaces, which holds nothing: the report
# names the motions
FACETED = 1e-2
# equality rows that resist less are soft supports: contact takes the load first
SOFT = 0.1
# 1 - |cos| of the angle between rows of B that count as one row; eigenvalue of a Gram matrix of
# unit rows that counts as zero
PARALLEL = rounding(1.0, GIVEN)

# -- data ------------------------------------------------------------------------------------------

# values that differ by no more than this count as equal: prescribed displacements relative to the
# largest one of their node, gaps relative to the sum of the magnitudes they are computed from
SAME_VALUE = 1e-10
# parts of positions and motions, relative to the body or the motion, that do not matter: places of
# the copies of a node, points on a line, and what is not named in messages; change of a certificate
# that counts as none
NEGLIGIBLE = 1e-6
# gap, relative to the largest penetration, that is far: it has no part in a contradiction
FAR = 1e6

# -- stiffness -------------------------------------------------------------------------------------

# energy of a rigid mode, relative to the largest entry of the stiffness matrix, below which the
# supports that resist it are soft: they get unknowns of their own. At half of it a problem takes 92
# products instead of 21, at twice it another one takes 124 instead of 168
SOFT_SUPPORT = 1e-3
# stiffness of a row of B on a surface, relative to that of its nodes (the diagonal of K): what
# neighbours give way that the diagonal takes as held. It decides which rows close first: at twice
# it a problem takes 21 products instead of 33, another one 152 instead of 141
SURFACE = 0.3

# -- accuracy --------------------------------------------------------------------------------------

# the certificate of an exact solution in double precision
CERTIFIED = 1e-9
# energy norm of a body, relative to that of its group, below which the body hardly deforms: its
# error need not be smaller than the tolerance times this part of the group's energy norm
HARDLY_DEFORMED = 1e-3
# energy norm of a body or a group, relative to that of all, below which it is nearly unloaded:
# where rounding ends the iterations its error may be as large as if it had this part
NEARLY_UNLOADED = 1e-6
# energy norms below this multiple of their rounding error are treated as zero. At twice it a
# problem takes 26 products instead of 53
UNDEFORMED = 1e5
