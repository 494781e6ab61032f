"""On how many ranks a test runs: without the mark ``ranks`` on one, those of tests/mpi on two."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI

import pytest

from ffcx.codegeneration import jit

RANKS = MPI.COMM_WORLD.size


def fits(item: pytest.Item) -> bool:
    """Return whether a test is for this number of ranks; those for three are also for more."""
    mark = item.get_closest_marker("ranks")
    numbers: tuple[int, ...] = (2,) if "mpi" in item.path.parts else (1,)
    if mark is not None:
        numbers = mark.args or (1, 2)
    return min(RANKS, 3) in numbers


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests for other numbers of ranks."""
    config.hook.pytest_deselected(items=[item for item in items if not fits(item)])
    items[:] = [item for item in items if fits(item)]


@pytest.fixture(scope="session", autouse=True)
def _modules_of_forms_are_loaded_once() -> Iterator[None]:
    """Keep the modules that FFCx has loaded, which lists its folder, of thousands, for each."""
    load, loaded = jit.get_cached_module, {}

    def get_cached_module(name: str, *arguments: Any) -> Any:
        objects, module = loaded.get(name) or load(name, *arguments)
        if module is not None:
            loaded[name] = objects, module
        return objects, module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jit, "get_cached_module", get_cached_module)
        yield


@pytest.fixture
def shared_folder() -> Iterator[Path]:
    """Return an empty folder that all ranks share."""
    comm = MPI.COMM_WORLD
    path = Path(comm.bcast(tempfile.mkdtemp() if comm.rank == 0 else None))
    yield path
    comm.barrier()
    if comm.rank == 0:
        shutil.rmtree(path)
