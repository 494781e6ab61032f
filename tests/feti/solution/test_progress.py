"""When the outer loop gives up: three passes, to a hundredth of the tolerance, without progress."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from fenics_tfeti.feti.solution.progress import Progress


def after(numbers: list[float], tolerances: list[float]) -> Progress:
    """Return the progress after passes with certificates of one number each."""
    progress = Progress()
    for number, tolerance in zip(numbers, tolerances, strict=True):
        progress.update(SimpleNamespace(bound=number, worst=number), tolerance)
    return progress


@pytest.mark.parametrize(
    ("numbers", "tolerances", "stagnates"),
    [
        ([1.0, 0.9, 0.8, 0.7], [1.0, 0.1, 0.01, 0.001], True),
        ([1.0, 0.9, 0.8], [1.0, 0.01, 0.001], False),  # two passes only
        ([1.0, 0.9, 0.8, 0.7], [1.0, 0.5, 0.25, 0.125], False),  # hardly smaller tolerances
        ([1.0, 0.9, 0.4, 0.39, 0.38], [1.0, 0.1, 0.01, 1e-3, 1e-4], False),  # halved on the way
        ([1.0, 1.0, 1.0, 1.0, 0.9], [1.0, 0.1, 1e-2, 1e-3, 1e-4], False),  # nothing was changed
    ],
)
def test_stagnation(numbers, tolerances, stagnates):
    assert after(numbers, tolerances).stagnates == stagnates


def test_passes_are_limited():
    numbers = [0.5**k for k in range(50)]
    assert not after(numbers[:49], numbers[:49]).stagnates
    assert after(numbers, numbers).stagnates
