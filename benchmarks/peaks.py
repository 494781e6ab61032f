"""The peak of resident memory within each phase of a solve, as Linux counts it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fenics_tfeti.feti import Timer

PROCESS = Path("/proc/self")


def peak_since_last() -> int:
    """Return the process's peak of resident memory since the last call [bytes]."""
    lines = dict(line.split(":", 1) for line in (PROCESS / "status").read_text().splitlines())
    (PROCESS / "clear_refs").write_text("5")  # resets the peak
    return 1024 * int(lines["VmHWM"].split()[0])


@contextmanager
def peaks_by_phase() -> Iterator[dict[str, int]]:
    """Fill a dictionary with the largest peak [bytes] in each phase of solves within the block.

    What is between phases counts as that of the phase before; `report.peak_memory_bytes` is then
    that since the end of a phase.
    """
    peaks, timed, names = dict[str, int](), Timer.phase, ["begin"]

    def count() -> None:
        peaks[names[-1]] = max(peaks.get(names[-1], 0), peak_since_last())

    @contextmanager
    def phase(timer: Timer, name: str) -> Iterator[None]:
        count()
        names.append(name)
        try:
            with timed(timer, name):
                yield
        finally:
            count()

    Timer.phase = phase  # type: ignore[method-assign]
    try:
        yield peaks
        count()
    finally:
        Timer.phase = timed  # type: ignore[method-assign]
