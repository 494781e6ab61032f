"""Entries of B by global row number, before the rows have a layout over the ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class Entries:
    """Entries of B in the columns of this rank."""

    rows: Numbers  # (e,): global row numbers
    columns: Numbers  # (e,): torn unknowns of this rank
    values: Vector  # (e,)

    @staticmethod
    def concatenate(parts: Sequence[Entries]) -> Entries:
        """Return the entries of all parts."""
        return Entries(
            np.concatenate([part.rows for part in parts]),
            np.concatenate([part.columns for part in parts]),
            np.concatenate([part.values for part in parts]),
        )
