"""Wall time by phase."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from mpi4py import MPI

import numpy as np


@dataclass
class Timer:
    """Wall time by phase.

    Attributes
    ----------
    seconds : dict
        Time of each phase on this rank [s].
    clock : callable
        Returns the present time [s].
    """

    seconds: dict[str, float] = field(default_factory=dict)
    clock: Callable[[], float] = time.perf_counter
    _last_lap: float = field(default=0.0, init=False, repr=False)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time of a block to a phase."""
        start = self.clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - start

    def slowest(self, comm: MPI.Intracomm) -> dict[str, float]:
        """Return the slowest rank's time of each phase, and their ``total`` [s]. Collective."""
        slowest = np.array(list(self.seconds.values()), dtype=float)
        comm.Allreduce(MPI.IN_PLACE, slowest, MPI.MAX)
        seconds = dict(zip(self.seconds, slowest.tolist(), strict=True))
        return {**seconds, "total": sum(seconds.values())}

    def lap(self, comm: MPI.Intracomm) -> float:
        """Return the ``total`` of `slowest` since the last lap [s]. Collective."""
        total = self.slowest(comm)["total"]
        lap, self._last_lap = total - self._last_lap, total
        return lap

    def restart(self) -> None:
        """Forget all phases."""
        self.seconds.clear()
        self._last_lap = 0.0
