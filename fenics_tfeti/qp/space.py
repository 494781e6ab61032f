"""Inner products of vectors on one rank, or distributed over several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.typing import Vector


def _same_array(values: Vector) -> Vector:
    return values


@dataclass(frozen=True)
class Space:
    """The Euclidean inner product of distributed vectors.

    A rank holds the components that it needs; those that it owns come first. Each component is
    owned by exactly one of the ranks that hold it, and counted there in sums. By default a vector
    is on one rank.

    Attributes
    ----------
    owned : int or None
        Number of owned components; None for all.
    sum_over_ranks : callable
        Adds up an array over all ranks.
    sum_and_min_over_ranks : callable
        The same, but for the last component the minimum over all ranks.

    Examples
    --------
    >>> import numpy as np
    >>> x, y = np.array([1.0, 2.0]), np.array([3.0, 4.0])
    >>> Space().dots((x, x), (x, y))
    [5.0, 11.0]
    """

    owned: int | None = None
    sum_over_ranks: Callable[[Vector], Vector] = _same_array
    sum_and_min_over_ranks: Callable[[Vector], Vector] = _same_array

    def partial(self, x: Vector, y: Vector) -> float:
        """Return this rank's part of the inner product x'y."""
        return float(x[: self.owned] @ y[: self.owned])

    def sums(self, *partial: float) -> list[float]:
        """Return several sums over all ranks by one reduction, given this rank's parts."""
        return self.sum_over_ranks(np.array(partial)).tolist()

    def dots(self, *pairs: tuple[Vector, Vector]) -> list[float]:
        """Return several inner products by one reduction."""
        return self.sums(*(self.partial(x, y) for x, y in pairs))

    def dots_and_min(self, *pairs: tuple[Vector, Vector], value: float) -> list[float]:
        """Return several inner products and the smallest value of all ranks by one reduction."""
        partial = [*(self.partial(x, y) for x, y in pairs), value]
        return self.sum_and_min_over_ranks(np.array(partial)).tolist()

    def norm(self, x: Vector) -> float:
        """Return the Euclidean norm of x."""
        return float(np.sqrt(self.dots((x, x))[0]))
