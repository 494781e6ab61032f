"""A bar in the terminal that shows how far a loop is."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Iterator
from typing import TextIO, TypeVar

from mpi4py import MPI

T = TypeVar("T")

_WIDTH = 30  # characters of a full bar
_ERASE = "\r\x1b[K"  # back to the begin of the line, and clear it


def progress(
    steps: Collection[T],
    label: str = "",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    stream: TextIO | None = None,
) -> Iterator[T]:
    """Loop over steps, and draw in a terminal how many are done and how long the others take.

    Nothing is written where the stream is not a terminal, as in files and pipes, and on ranks other
    than 0. The bar disappears with the loop, also if that ends by an exception.

    Parameters
    ----------
    steps : collection
        What to loop over, of known length.
    label : str
        What stands in front of the bar.
    comm : MPI.Intracomm
        The ranks of the loop.
    stream : file, optional
        Where the bar is drawn; by default the standard error stream.

    Yields
    ------
    object
        The steps.

    Examples
    --------
    >>> [2 * load for load in progress([1.0, 2.0, 3.0], "load step")]
    [2.0, 4.0, 6.0]
    """
    stream = sys.stderr if stream is None else stream
    drawn = comm.rank == 0 and stream.isatty()
    begin = time.perf_counter()
    try:
        for done, step in enumerate(steps):
            if drawn:
                line = progress_bar(label, done, len(steps), time.perf_counter() - begin)
                stream.write(_ERASE + line)
                stream.flush()
            yield step
    finally:
        if drawn:
            stream.write(_ERASE)
            stream.flush()


def progress_bar(label: str, done: int, steps: int, seconds: float) -> str:
    """Return the bar with its numbers, after so many steps and seconds."""
    filled = _WIDTH * done // steps
    bar = "#" * filled + "." * (_WIDTH - filled)
    left = f", {_clock(seconds * (steps - done) / done)} left" if done else ""
    return f"{label} [{bar}] {done}/{steps}, {_clock(seconds)}{left}".lstrip()


def _clock(seconds: float) -> str:
    """Return a time as minutes and seconds."""
    minutes, remainder = divmod(round(seconds), 60)
    return f"{minutes}:{remainder:02d}"
