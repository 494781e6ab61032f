"""Relative sizes below which a quantity counts as rounding, in one place for the layer.

Each constant says what it is relative to. Parameters of a single algorithm stand where it is
implemented.
"""

from __future__ import annotations

# values that differ by no more than this count as equal: prescribed displacements relative to the
# largest one of their node, gaps relative to the sum of the magnitudes they are computed from
SAME_VALUE = 1e-10
# rounding of positions relative to the largest coordinate: in displacements computed as differences
# of positions, and in gaps, which may come from surfaces far from the origin
ROUNDED_POSITION = 16 * 2.0**-52
ROUNDED_GAP = 1e-12
# |K - K'| relative to |K|
SYMMETRIC = 1e-9
# |TT' - I| of an orthogonal matrix T
ORTHOGONAL = 1e-12
# energy of a rigid mode relative to the largest stiffness: what rounding leaves of none, and below
# which a support is soft
ZERO_ENERGY = 8 * 2.0**-52
SOFT_SUPPORT = 1e-3
# ||B R xi|| below which no constraint resists a rigid motion, relative to its root mean square
# displacement, for rows of unit length
UNRESISTED = 1e-9
# the same, below which only the tilt of normals on faceted surfaces resists, which holds nothing
WEAKLY_RESISTED = 1e-2
# work of the load on a rigid motion, relative to the sum of forces on the bodies that move times
# the same displacement; closing speed relative to the motion
NO_WORK = 1e-9
# 1 - |cos| of the angle between rows of B that count as one row; eigenvalue of a Gram matrix of
# unit rows that counts as zero
PARALLEL = 1e-12
# the certificate of an exact solution in double precision
ROUNDING = 1e-9
# energy norm of a body, relative to that of its group, below which the body hardly deforms: its
# error need not be smaller than the tolerance times this part of the group's energy norm
HARDLY_DEFORMED = 1e-3
# energy norm of a body or a group, relative to that of all, below which it is nearly unloaded:
# where rounding ends the iterations its error may be as large as if it had this part
NEARLY_UNLOADED = 1e-6
# energy norm, in units of what rounding leaves of forces and displacements, that counts as none
UNDEFORMED = 1e5
