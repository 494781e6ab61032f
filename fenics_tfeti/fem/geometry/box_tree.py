"""A tree of bounding boxes around facets, descended for all queries at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fenics_tfeti.fem.geometry.vectors import highest, lowest
from fenics_tfeti.typing import Mask, Numbers, Vector


class BoxTree:
    """A balanced binary tree of boxes around facets with corners (m, v, gdim), level by level."""

    def __init__(self, corners: Vector) -> None:
        facets_of_leaf, count = 2, len(corners)
        if not count:
            # a box that meets nothing
            corners = np.full((1, *corners.shape[1:]), np.inf)
        depth = max(0, int(np.ceil(np.log2(len(corners) / facets_of_leaf))))
        leaf = -(-len(corners) // 2**depth)
        self._facets = lowest(corners), highest(corners)
        # copies of some facets, so that all boxes of a level hold equally many
        order = np.arange(2**depth * leaf)
        copied = np.resize(np.arange(len(corners)), order.size)
        low, high = (ends[copied] for ends in self._facets)
        # axis by axis: faster than NumPy's reduction of short axes
        axes = [np.ascontiguousarray(column) for column in (0.5 * (low + high)).T]
        for level in range(depth + 1):
            order = order.reshape(2**level, -1)
            if level < depth:
                places = [column[order] for column in axes]
                longest = np.argmax([x.max(axis=1) - x.min(axis=1) for x in places], axis=0)
                place = np.choose(longest[:, None], places)
                order = np.take_along_axis(order, place.argsort(axis=1), axis=1)
        self._leaves: Numbers = np.where(order < count, order, -1)
        # from the leaves up: the box of two halves is that around their boxes
        self._low, self._high = [low[order].min(axis=1)], [high[order].max(axis=1)]
        for _ in range(depth):
            self._low.append(np.minimum(self._low[-1][::2], self._low[-1][1::2]))
            self._high.append(np.maximum(self._high[-1][::2], self._high[-1][1::2]))
        self._low.reverse()
        self._high.reverse()

    @property
    def size(self) -> float:
        """The longest side of the box around all facets [m]."""
        return float((self._high[0] - self._low[0]).max())

    def boxes(self, limit: int = 64) -> tuple[Vector, Vector]:
        """Return lower and upper corners (b, gdim) of a level with as many boxes up to `limit`."""
        level = max(k for k, low in enumerate(self._low) if len(low) <= max(1, limit))
        return self._low[level], self._high[level]

    def candidates(
        self, number: int, meets_box: Callable[[Numbers, Vector, Vector], Mask]
    ) -> tuple[Numbers, Numbers]:
        """Find the facets whose boxes queries meet: pairs, each once, by ascending query.

        The predicate gets queries (j,) and lower and upper corners (j, gdim) of boxes; what is true
        of a box has to be true of the boxes around it.
        """
        query, box = np.arange(number, dtype=np.int64), np.zeros(number, dtype=np.int64)

        def meeting(query: Numbers, box: Numbers, *ends: Vector) -> tuple[Numbers, Numbers]:
            # faster than indices
            keep = np.flatnonzero(meets_box(query, *(end.take(box, axis=0) for end in ends)))
            return query.take(keep), box.take(keep)

        for level, ends in enumerate(zip(self._low, self._high, strict=True)):
            if level > 0:
                query, box = np.repeat(query, 2), (2 * box[:, None] + [0, 1]).ravel()
            query, box = meeting(query, box, *ends)
        query, facet = np.repeat(query, self._leaves.shape[1]), self._leaves[box].ravel()
        original = np.flatnonzero(facet >= 0)
        return meeting(query.take(original), facet.take(original), *self._facets)
