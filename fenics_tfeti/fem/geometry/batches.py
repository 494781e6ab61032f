"""Rows in batches, so that temporary arrays stay small."""

from __future__ import annotations

from collections.abc import Iterator


def batches(count: int, size: int) -> Iterator[slice]:
    """Return slices of at most `size` that cover `count` rows."""
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))
