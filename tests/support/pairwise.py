"""Few cases of many parameters: each pair of values of two of them is in one case or more."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations, product
from typing import Any


def pairwise(*axes: Iterable[Any]) -> list[tuple[Any, ...]]:
    """Return cases for `parametrize` that have each pair of values of the axes, greedily."""
    values = [list(axis) for axis in axes]
    candidates = list(product(*(range(len(axis)) for axis in values)))
    pairs = {case: set(combinations(enumerate(case), 2)) for case in candidates}
    missing = set().union(*pairs.values())
    cases = []
    while missing:
        best = max(candidates, key=lambda case: len(pairs[case] & missing))
        missing -= pairs[best]
        cases.append(tuple(axis[i] for axis, i in zip(values, best, strict=True)))
    return cases
