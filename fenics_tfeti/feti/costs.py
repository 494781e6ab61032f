"""Sizes of blocks: they decide about memory and time, not about results."""

from __future__ import annotations

# right-hand sides that are solved for at once: a factor is read once for all of them, and they are
# a dense matrix for that long
COLUMNS = 64
# rows of a matrix, one for each subdomain, that are treated at once: with their transposes and
# products they stay in the cache
ROWS = 64
# entries, zeros as well, of a sparse matrix up to which the product of a dense one with a vector
# takes less time than SciPy's call
DENSE = 10_000
