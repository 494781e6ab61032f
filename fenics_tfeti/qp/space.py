"""Inner products of vectors that one process holds, or that many share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Space"]

Vector = NDArray[np.float64]


def _same_array(values: Vector) -> Vector:
    return values


@dataclass(frozen=True)
class Space:
    """The Euclidean space of the unknowns.

    A process holds the components that it needs; those that it also counts in sums, its *owned*
    ones, come first. A component held by several processes is owned by exactly one of them.
    The default is a vector held by one process alone.

    Attributes
    ----------
    owned : int or None
        Number of owned components; None means all.
    sum_over_ranks : callable
        Sums an array of partial sums over all processes.
    sum_and_min_over_ranks : callable
        Sums all numbers of an array over all processes but the last, of which it takes the
        smallest.

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
        """Return this process's part of the inner product x'y."""
        return float(x[: self.owned] @ y[: self.owned])

    def sums(self, *partial: float) -> list[float]:
        """Sum several partial sums over all processes in one reduction."""
        total: list[float] = self.sum_over_ranks(np.array(partial)).tolist()
        return total

    def dots(self, *pairs: tuple[Vector, Vector]) -> list[float]:
        """Return several inner products for the price of one reduction."""
        return self.sums(*(self.partial(x, y) for x, y in pairs))

    def dots_and_min(self, *pairs: tuple[Vector, Vector], value: float) -> list[float]:
        """Return several inner products and the smallest of the processes' values, likewise."""
        partial = [*(self.partial(x, y) for x, y in pairs), value]
        total: list[float] = self.sum_and_min_over_ranks(np.array(partial)).tolist()
        return total

    def norm(self, x: Vector) -> float:
        """Return the Euclidean norm of x."""
        return float(np.sqrt(self.dots((x, x))[0]))
