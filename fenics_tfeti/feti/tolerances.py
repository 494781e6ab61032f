"""Relative sizes below which a quantity counts as rounding, in one place for the layer.

Each constant says what it is relative to. Parameters of a single algorithm stand where it is
implemented.
"""

from __future__ import annotations

__all__ = [
    "NO_WORK",
    "PARALLEL",
    "ROUNDING",
    "SAME_VALUE",
    "SYMMETRIC",
    "UNRESISTED",
    "ZERO_ENERGY",
]

# two values prescribed for one displacement, relative to the largest prescribed one
SAME_VALUE = 1e-10
# |K - K'| relative to |K|
SYMMETRIC = 1e-9
# energy of a rigid mode below which K is singular for it, relative to the largest stiffness
ZERO_ENERGY = 1e-9
# ||B R xi|| below which no constraint resists a rigid motion, relative to its root mean square
# displacement, for rows of unit length
UNRESISTED = 1e-9
# work of the load on a rigid motion, relative to the sum of forces on the bodies that move times
# the same displacement; closing speed relative to the motion
NO_WORK = 1e-9
# 1 - |cos| of the angle between rows of B that count as one row; eigenvalue of a Gram matrix of
# unit rows that counts as zero
PARALLEL = 1e-12
# the certificate of an exact solution in double precision
ROUNDING = 1e-9
