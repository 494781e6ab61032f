"""The table of contact, tied and tangential rows of B: kind, contact, scale, site, direction.

All other rows of B, which are most, are gluing rows and supports, equalities with no more data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from fenics_tfeti.typing import Array, Mask, Numbers, Vector


class Kind(IntEnum):
    """The kind of a row of B."""

    TIED = 0
    HELD = 1  # a contact row that holds with equality
    CONTACT = 2
    TANGENT = 3  # of a site of friction


@dataclass(frozen=True)
class RowTable:
    """The rows of the conditions that a rank gives, or those of B that it holds."""

    # (r,): global number, or position among the rows that a rank holds, then ascending; -1 of a
    # condition that is no row of B
    number: Numbers
    kind: Numbers  # (r,): `Kind`
    contact: Numbers  # (r,): number of the contact, of the first one
    scale: Vector  # (r,): makes B D^{-1} B' = 1 of the condition whose slave's sum has length 1
    site: Numbers  # (r,): global number of the contact row with friction; -1 of other kinds
    direction: Numbers  # (r,): number of the tangent; -1 of other kinds

    @property
    def columns(self) -> Sequence[Array]:
        """All data as columns (r,)."""
        return list(vars(self).values())

    def of(self, *kinds: Kind) -> RowTable:
        """Return the rows of some kinds."""
        return self.chosen(np.isin(self.kind, kinds))

    def where(self, *kinds: Kind) -> Numbers:
        """Return the numbers of the rows of some kinds."""
        return self.number[np.isin(self.kind, kinds)]

    def chosen(self, rows: Numbers | Mask) -> RowTable:
        """Return some rows."""
        return RowTable(*(column[rows] for column in self.columns))

    def concatenate(self, rows: RowTable) -> RowTable:
        """Return these rows with others behind them."""
        pairs = zip(self.columns, rows.columns, strict=True)
        return RowTable(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class GivenRows:
    """The contact rows, or the tied rows, that this rank gave.

    Of these, rows that are far away, that prescribed displacements or tied rows decide and that are
    farther away than a parallel one are no rows of B. Equal ones are one row.
    """

    own_rows: Numbers  # (g,): local positions; -1 for no row of B
    share: Vector  # (g,): part of the row's force, with a sign
    scale: Vector  # (g,): t with which they are the row of B; 1 for none

    def forces(self, multipliers: Vector) -> Vector:
        """Return the force of each row [N]; 0 if it is no row of B.

        It acts on the slave against the row's normal.
        """
        force: Vector = self.share * (self.scale * np.append(multipliers, 0.0)[self.own_rows])
        return force
