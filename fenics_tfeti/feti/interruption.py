"""Ctrl-C (SIGINT) during a solve: all ranks stop in the same iteration, and keep the last iterate.

Python raises KeyboardInterrupt wherever it is, on the rank that got the signal alone; the others
would wait for it. While the signal is deferred it only sets a flag, which the ranks exchange along
with the sums of each iteration (`constraints.dual_layout`).
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from mpi4py import MPI

from fenics_tfeti.errors import Interrupted


@dataclass
class _Signals:
    """State of this process: the depth of nested solves, and whether signals were received.

    `received` is set on the rank that got the signal, `agreed` when all ranks know of it.
    """

    depth: int = 0
    received: bool = False
    agreed: bool = False


_signals = _Signals()


def received() -> bool:
    """Tell whether this rank got the signal since it was deferred."""
    return _signals.received


def agree(any_rank: bool) -> None:
    """Take in, on all ranks together, whether one of them got the signal."""
    _signals.agreed = _signals.agreed or (any_rank and _signals.depth > 0)


def agreed() -> bool:
    """Tell, with one answer on all ranks, whether the iterations have to end."""
    return _signals.agreed


@contextmanager
def deferred() -> Iterator[None]:
    """Let SIGINT set a flag in a block, where it would raise KeyboardInterrupt; again, it raises.

    Handlers of others than Python are left as they are, and so are threads but the main one.
    """
    main = threading.current_thread() is threading.main_thread()
    handled = main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    _signals.depth += 1
    if handled:
        signal.signal(signal.SIGINT, _set_flag)
    try:
        yield
    finally:
        _signals.depth -= 1
        if handled:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if _signals.depth == 0:
            unseen = _signals.received and not _signals.agreed
            _signals.received = _signals.agreed = False
            if unseen:
                # after the last check of the ranks, or another error came before one
                raise KeyboardInterrupt


def _set_flag(number: int, frame: FrameType | None) -> None:
    if _signals.received:
        signal.default_int_handler(number, frame)
    _signals.received = True


def check(comm: MPI.Intracomm) -> None:
    """Raise `Interrupted` on all ranks if one of them got the signal. Collective."""
    agree(comm.allreduce(received(), MPI.LOR))
    if agreed():
        raise Interrupted("interrupted, before there was an iterate")
