"""The table of the rows of B: what each one is, its contact, scale, site and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from fenics_tfeti.typing import Array, Mask, Numbers, Vector


class Kind(IntEnum):
    """What a row of B is of."""

    GLUE = 0
    SUPPORT = 1
    TIED = 2
    HELD = 3  # a contact row that holds with equality
    CONTACT = 4
    TANGENT = 5  # of a site of friction


@dataclass(frozen=True)
class RowTable:
    """Rows of B: those that a rank holds, in local order, or those of the conditions it gives."""

    number: Numbers  # (r,): global row number; -1 of a condition that is no row of B
    kind: Numbers  # (r,): `Kind`
    contact: Numbers  # (r,): number of the contact, of the first one; -1 for none
    scale: Vector  # (r,): makes B D^{-1} B' = 1 of the condition whose slave's sum has length 1
    site: Numbers  # (r,): global number of the contact row with friction; -1 of other kinds
    direction: Numbers  # (r,): number of the tangent; -1 of other kinds

    @staticmethod
    def of_kind(number: Numbers, kind: Kind) -> RowTable:
        """Return gluing rows or supports."""
        kinds, (contact, site, direction) = (
            np.full(number.size, int(kind)),
            np.full((3, number.size), -1, dtype=np.int64),
        )
        return RowTable(number.copy(), kinds, contact, np.ones(number.size), site, direction)

    @property
    def columns(self) -> Sequence[Array]:
        """All data as columns (r,)."""
        return list(vars(self).values())

    def where(self, *kinds: Kind) -> Numbers:
        """Return the positions of the rows of some kinds, ascending."""
        return np.flatnonzero(np.isin(self.kind, kinds))

    def chosen(self, rows: Numbers | Mask) -> RowTable:
        """Return some rows."""
        return RowTable(*(column[rows] for column in self.columns))

    def inserted(self, at: int, rows: RowTable) -> RowTable:
        """Return the rows with others from a position on."""
        pairs = zip(self.columns, rows.columns, strict=True)
        return RowTable(*(np.concatenate([x[:at], y, x[at:]]) for x, y in pairs))


@dataclass(frozen=True)
class GivenRows:
    """The contact rows, or the tied rows, that this rank gave.

    Of these, rows that are far away, that prescribed displacements or tied rows decide and that are
    farther away than a parallel one are no rows of B. Equal ones are one row.
    """

    own_rows: Numbers  # (g,): local positions; -1 for no row of B
    share: Vector  # (g,): part of the row's force, with a sign
    scale: Vector  # (g,): t of the row of B; 1 for none

    def forces(self, multipliers: Vector) -> Vector:
        """Return the force of each row [N]; 0 if it is no row of B.

        It acts on the slave against the row's normal.
        """
        force: Vector = self.share * (self.scale * np.append(multipliers, 0.0)[self.own_rows])
        return force
