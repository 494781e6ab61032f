"""The rows that hold the ground of soft elastic supports: y = o (`local.elastic_supports`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.row_table import GivenRows
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.parallel import count_over_ranks, first_of_rank
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class TornUnknowns:
    """The torn unknowns of this rank: each subdomain's displacements, and after them its ground."""

    sizes: Numbers  # (subdomains,): number of displacements of each
    grounds: Numbers  # (subdomains,): number of unknowns of its ground

    @property
    def ends(self) -> Numbers:
        """First unknown of each subdomain, and the end of the last."""
        ends: Numbers = np.concatenate([[0], np.cumsum(self.sizes + self.grounds)])
        return ends.astype(np.int64)

    @property
    def displacements(self) -> Numbers:
        """Positions of the displacements among all unknowns."""
        shift = np.cumsum(self.grounds) - self.grounds
        return np.arange(int(self.sizes.sum()), dtype=np.int64) + np.repeat(shift, self.sizes)

    def without_ground(self, torn: NDArray[Any]) -> NDArray[Any]:
        """Return the entries of displacements; the given array itself where there is no ground."""
        return torn[self.displacements] if self.grounds.any() else torn

    def with_ground(self, displacements: Vector) -> Vector:
        """Return a vector of displacements, or of forces on them, with zeros for the ground.

        It is the given one where there is no ground.
        """
        if not self.grounds.any():
            return displacements
        torn = np.zeros(int(self.ends[-1]))
        torn[self.displacements] = displacements
        return torn

    def split(self, torn: Vector) -> list[Vector]:
        """Return the displacements of each subdomain."""
        starts = self.ends[:-1]
        return [torn[start : start + n] for start, n in zip(starts, self.sizes, strict=True)]


def hold_ground(
    constraints: Constraints, c: Vector, unknowns: TornUnknowns
) -> tuple[Constraints, Vector]:
    """Add an equality row y = 0 for each unknown of the ground. Collective.

    Returns B with the columns and rows of the ground, and its c (m,); the same objects where no
    rank has any.
    """
    layout, new = constraints.layout, int(unknowns.grounds.sum())
    offset, total = first_of_rank(layout.comm, new)
    if not total:
        return constraints, c
    first = count_over_ranks(layout.comm, layout.numbers) + offset
    numbers = np.append(layout.numbers, first + np.arange(new))

    # nobody else holds the new rows, which follow the owned ones
    places = np.arange(constraints.size)
    places[layout.owned :] += new

    displacements = unknowns.displacements
    ground = np.setdiff1d(np.arange(unknowns.ends[-1]), displacements)
    weights = np.ones(int(unknowns.ends[-1]))
    weights[displacements] = constraints.weights
    weights[ground] = _mean_weights(constraints.weights, unknowns)
    old, ground_rows = constraints.matrix.tocoo(), layout.owned + np.arange(new)
    rows = np.concatenate([places[old.row], ground_rows])
    columns = np.concatenate([displacements[old.col], ground])
    values = np.concatenate([old.data, np.sqrt(weights[ground])])
    shape = numbers.size, weights.size
    extended = replace(
        constraints,
        matrix=sp.csr_matrix((values, (rows, columns)), shape),
        layout=DualLayout(layout.comm, numbers, np.arange(numbers.size)),
        rows=replace(constraints.rows, number=places[constraints.rows.number]),
        contacts=_moved(constraints.contacts, places),
        tied=_moved(constraints.tied, places),
        weights=weights,
        coupling=replace(constraints.coupling, rows=places[constraints.coupling.rows]),
        friction=constraints.friction.moved(places),
    )
    return extended, np.insert(c, layout.owned, np.zeros(new))


def _moved(given: GivenRows, places: Numbers) -> GivenRows:
    """Return the rows at new local positions, by the old ones."""
    return replace(given, own_rows=np.append(places, -1)[given.own_rows])


def _mean_weights(weights: Vector, unknowns: TornUnknowns) -> Vector:
    """Return the mean weight of its subdomain for each unknown of the ground."""
    subdomain = np.repeat(np.arange(unknowns.sizes.size), unknowns.sizes)
    sums = np.bincount(subdomain, weights=weights, minlength=unknowns.sizes.size)
    return np.repeat(sums / np.maximum(unknowns.sizes, 1), unknowns.grounds)
