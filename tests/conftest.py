"""Which tests run on how many ranks: without the mark ``ranks`` on one."""

from __future__ import annotations

from mpi4py import MPI

import pytest

RANKS = MPI.COMM_WORLD.size


def fits(item: pytest.Item) -> bool:
    """Return whether a test is for this number of ranks; those of tests/mpi are for any."""
    mark = item.get_closest_marker("ranks")
    if mark is None:
        return RANKS == 1 or "mpi" in item.path.parts
    least = mark.args[0] if mark.args else 1
    return least <= RANKS <= mark.kwargs.get("most", RANKS)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests for other numbers of ranks."""
    config.hook.pytest_deselected(items=[item for item in items if not fits(item)])
    items[:] = [item for item in items if fits(item)]
