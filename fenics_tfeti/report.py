"""The report of a contact problem: that of the solver, the pairing and the geometry passes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fenics_tfeti.fem.contact.deformed import GeometryPass
from fenics_tfeti.feti import Report

__all__ = ["ContactReport", "pairing_table"]


@dataclass(frozen=True)
class ContactReport(Report):
    """The solver's report with what belongs to the geometry; equal on all ranks.

    Attributes
    ----------
    passes : list of GeometryPass
        One entry for each solution with exact non-penetration; products and history of the report
        are those of the last one, its seconds those of all passes.
    pairing : list of dict
        For each contact its name, the numbers of ``pairs`` and ``unmatched`` slave nodes,
        ``largest_distance`` [m] (what the tolerance limits; None for obstacles) and
        ``largest_relative_distance`` (to the size of the facets), ``largest_angle`` between the
        slave's normal and the opposite of its partner's [degrees], ``smallest_gap`` and
        ``largest_gap`` [m]. Nodes at which an obstacle's gap is infinite are unmatched.
    """

    passes: list[GeometryPass] = field(default_factory=list)
    pairing: list[dict[str, Any]] = field(default_factory=list)

    def pairing_table(self) -> str:
        """Return `pairing` as a table to read, a line for each contact."""
        return pairing_table(self.pairing)


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
