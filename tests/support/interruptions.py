"""Interruptions in the middle of a solve."""

from __future__ import annotations

from collections.abc import Callable

import pytest

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
