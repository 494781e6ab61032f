"""Free what a module has cached: MUMPS holds communicators, and MPICH has only 2048 of them."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def _cached_problems_are_freed(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    for cached in vars(request.module).values():
        if hasattr(cached, "cache_clear"):
            cached.cache_clear()
    gc.collect()
