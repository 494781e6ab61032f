"""Tolerances of the `fem` layer; each is relative to what its comment names.

Parameters of algorithms, such as sizes of blocks and ratios, are in the functions that use them.
"""

from __future__ import annotations

# -- rounding ----------------------------------------------------------------------------------

# Lengths and differences of coordinates, relative to the largest coordinate; differences of unit
# vectors, relative to 1.
COORDINATE_ROUNDING = 1e-13

# Numbers of order one that take several operations: cosines, barycentric coordinates, weights of
# interpolation, ratios of distances or areas, lengths relative to the size of a body.
RELATIVE_ROUNDING = 1e-9

# Barycentric coordinates: a point nearer to a corner or an edge of a facet is on it.
ON_CORNER = 1e-12

# Prescribed displacements of one degree of freedom, relative to the largest ones.
SAME_VALUE = 1e-10

# -- degenerate geometry -----------------------------------------------------------------------

# Determinant of a cell's Jacobian, relative to (size of the cell)^dim, below which it is flat.
FLAT_CELL = 1e-10

# Distance of two nodes, relative to the shortest edge at either, below which they are at the same
# place. Coordinates in single precision still agree to this; a gap that is meant is larger.
SAME_PLACE = 1e-5

# Length of a vector that has no direction: relative to the longest vector of a field, or, from the
# centre or axis of a round obstacle, to its radius.
NO_DIRECTION = 1e-12

# Integral of the normal over the facets at a node, relative to their area, below which the normals
# cancel.
VANISHING_NORMAL = 1e-3

# Deviation of the length of a user's unit normals from 1.
UNIT_LENGTH = 1e-6

# Depth in the other body of a node that no mortar condition speaks of, relative to the deformation
# of the slave's surface, above which it is told.
VISIBLE_PENETRATION = 0.05

# Sine of the angle between the gradient of a user's gap and the normal, above which there is a
# warning: 12 degrees.
NOT_GRADIENT = 0.2

# -- far away ----------------------------------------------------------------------------------

# Gap of an obstacle [m] from which on it counts as infinite: squares of much larger ones overflow.
NO_OBSTACLE = 1e100
