"""Interruptions in the middle of a solve."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from fenics_tfeti.feti import Timer
from fenics_tfeti.feti.dual.operator import DualOperator


def interrupt_after(
    monkeypatch: pytest.MonkeyPatch, products: int, interrupt: Callable[[], None]
) -> None:
    """Call a function during a product with F, the number of which is given."""
    apply, count = DualOperator.packed, 0

    def counting(self, x):
        nonlocal count
        count += 1
        if count == products:
            interrupt()
        return apply(self, x)

    monkeypatch.setattr(DualOperator, "packed", counting)


class InterruptedTimer(Timer):
    """The timer of a solver that is interrupted in a phase of its set-up."""

    def __init__(self, name: str, interrupt: Callable[[], None]) -> None:
        super().__init__()
        self.name, self.interrupt = name, interrupt

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        with super().phase(name):
            if name == self.name:
                self.interrupt()
            yield
