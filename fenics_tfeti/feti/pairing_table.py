"""The pairing of contacts as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["pairing_table"]

_COLUMNS = {
    "contact": "contact",
    "pairs": "pairs",
    "unmatched": "unmatched",
    "largest_distance": "distance [m]",
    "largest_relative_distance": "of a facet",
    "largest_angle": "angle [deg]",
    "smallest_gap": "gap from [m]",
    "largest_gap": "to [m]",
}


def pairing_table(pairing: Sequence[Mapping[str, Any]]) -> str:
    """Write the pairing of contacts as a table, a line for each contact.

    Parameters
    ----------
    pairing : sequence of mapping
        See `Report.pairing`.

    Returns
    -------
    str
        Largest distances and angles, smallest and largest gaps; "-" where an obstacle has none.

    Examples
    --------
    >>> entry = {"contact": "joint", "pairs": 25, "unmatched": 0, "largest_distance": 1e-17}
    >>> entry |= {"largest_relative_distance": 4e-17, "largest_angle": 0.0}
    >>> print(pairing_table([entry | {"smallest_gap": 0.0, "largest_gap": 0.01}]))
    contact  pairs  unmatched  distance [m]  of a facet  angle [deg]  gap from [m]  to [m]
    joint       25          0         1e-17       4e-17            0             0    0.01
    """
    rows = [list(_COLUMNS.values())]
    rows += [[_word(entry[key]) for key in _COLUMNS] for entry in pairing]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])],
        )
        for row in rows
    )


def _word(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
