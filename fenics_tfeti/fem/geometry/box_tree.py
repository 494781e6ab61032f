"""A tree of bounding boxes around facets, descended for all queries at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from fenics_tfeti.fem.geometry.vectors import highest, lowest
from fenics_tfeti.typing import Mask, Numbers, Vector

# pairs of a query and a facet that are tested one by one: faster than a tree
_FEW = 10_000


class BoxTree:
    """A balanced binary tree of boxes around facets with corners (m, v, gdim), level by level."""

    def __init__(self, corners: Vector) -> None:
        self._count = len(corners)
        if not self._count:
            # a box that meets nothing
            corners = np.full((1, *corners.shape[1:]), np.inf)
        self._facets = lowest(corners), highest(corners)

    @cached_property
    def _levels(self) -> tuple[Numbers, list[Vector], list[Vector]]:
        """The facets of each leaf, -1 for none, and the corners of the boxes of each level."""
        facets_of_leaf, count = 2, len(self._facets[0])
        depth = max(0, int(np.ceil(np.log2(count / facets_of_leaf))))
        leaf = -(-count // 2**depth)
        # copies of some facets, so that all boxes of a level hold equally many
        order = np.arange(2**depth * leaf)
        copied = np.resize(np.arange(count), order.size)
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
        leaves: Numbers = np.where(order < self._count, order, -1)
        # from the leaves up: the box of two halves is that around their boxes
        lows, highs = [low[order].min(axis=1)], [high[order].max(axis=1)]
        for _ in range(depth):
            lows.append(np.minimum(lows[-1][::2], lows[-1][1::2]))
            highs.append(np.maximum(highs[-1][::2], highs[-1][1::2]))
        return leaves, lows[::-1], highs[::-1]

    @property
    def size(self) -> float:
        """The longest side of the box around all facets [m]."""
        low, high = self._facets
        return float((high.max(axis=0) - low.min(axis=0)).max())

    def boxes(self, limit: int = 64) -> tuple[Vector, Vector]:
        """Return lower and upper corners (b, gdim) of a level with as many boxes up to `limit`."""
        _, lows, highs = self._levels
        level = max(k for k, low in enumerate(lows) if len(low) <= max(1, limit))
        return lows[level], highs[level]

    def candidates(
        self, number: int, meets_box: Callable[[Numbers, Vector, Vector], Mask]
    ) -> tuple[Numbers, Numbers]:
        """Find the facets whose boxes queries meet: pairs, each once, by query and then by facet.

        The predicate gets queries (j,) and lower and upper corners (j, gdim) of boxes; what is true
        of a box has to be true of the boxes around it.
        """

        def meeting(query: Numbers, box: Numbers, *ends: Vector) -> tuple[Numbers, Numbers]:
            # faster than indices
            keep = np.flatnonzero(meets_box(query, *(end.take(box, axis=0) for end in ends)))
            return query.take(keep), box.take(keep)

        query = np.arange(number, dtype=np.int64)
        if number * self._count <= _FEW:
            query, facet = np.repeat(query, self._count), np.tile(np.arange(self._count), number)
            return meeting(query, facet, *self._facets)
        box = np.zeros(number, dtype=np.int64)
        leaves, lows, highs = self._levels
        for level, ends in enumerate(zip(lows, highs, strict=True)):
            if level > 0:
                query, box = np.repeat(query, 2), (2 * box[:, None] + [0, 1]).ravel()
            query, box = meeting(query, box, *ends)
        query, facet = np.repeat(query, leaves.shape[1]), leaves[box].ravel()
        original = np.flatnonzero(facet >= 0)
        query, facet = meeting(query.take(original), facet.take(original), *self._facets)
        order = np.argsort(query * self._count + facet, kind="stable")
        return query.take(order), facet.take(order)
