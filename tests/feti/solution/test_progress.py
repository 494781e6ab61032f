"""When the outer loop gives up: three passes, to a hundredth of the tolerance, without progress."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from fenics_tfeti.feti.solution.progress import Progress, Stagnation

# rounding far below all tolerances
SCALE = SimpleNamespace(energy_norm=1.0, rounding_at=lambda energy_norm: 0.0)


def judged(numbers: list[float], tolerances: list[float]) -> list[Stagnation]:
    """Return what is said of passes with certificates of one number each."""
    progress = Progress.start(SCALE)
    return [
        progress.judge(SimpleNamespace(bound=x, worst=x, energy_norm=1.0), tolerance)
        for x, tolerance in zip(numbers, tolerances, strict=True)
    ]


@pytest.mark.parametrize(
    ("numbers", "tolerances", "stagnates"),
    [
        ([1.0, 0.9, 0.8, 0.7], [1.0, 0.1, 0.01, 0.001], True),
        ([1.0, 0.9, 0.8], [1.0, 0.01, 0.001], False),  # two passes only
        ([1.0, 0.9, 0.8, 0.7], [1.0, 0.5, 0.25, 0.125], False),  # hardly smaller tolerances
        ([1.0, 0.9, 0.4, 0.39, 0.38], [1.0, 0.1, 0.01, 1e-3, 1e-4], False),  # halved on the way
        ([1.0, 1.0, 1.0, 1.0, 0.9], [1.0, 0.1, 1e-2, 1e-3, 1e-4], False),  # nothing was changed
        ([1.0, 0.9, 0.9 - 1e-8, 0.9 - 2e-8, 0.8], [1.0, 0.1, 1e-2, 1e-3, 1e-4], False),  # nor here
    ],
)
def test_stagnation(numbers, tolerances, stagnates):
    assert (judged(numbers, tolerances)[-1] is Stagnation.FINAL) == stagnates


def test_passes_are_limited():
    numbers = [0.5**k for k in range(50)]
    *before, last = judged(numbers, numbers)
    assert set(before) == {Stagnation.NONE} and last is Stagnation.FINAL


def test_passes_of_another_method_are_counted_anew():
    progress, certificate = Progress.start(SCALE), SimpleNamespace(bound=1, worst=1, energy_norm=1)
    numbers, tolerances = [1.0, 0.9, 0.8, 0.7], [1.0, 0.1, 0.01, 0.001]
    for x, tolerance in zip(numbers, tolerances, strict=True):
        certificate.bound = certificate.worst = x
        last = progress.judge(certificate, tolerance)
    assert last is Stagnation.FINAL
    progress.restart()
    assert progress.judge(certificate, 1e-3) is Stagnation.NONE


@pytest.mark.parametrize(
    ("bound", "expected"),
    [(1e-3, Stagnation.FINAL), (1e-5, Stagnation.FINAL), (1e-2, Stagnation.NONE)],
)
def test_rounding_ends_the_passes(bound, expected):
    """Rounding of energies of 1e-3 is 1e-4 of a residual that measures a tenth of the energy."""
    scale = SimpleNamespace(energy_norm=1.0, rounding_at=lambda energy_norm: 1e-3)
    certificate = SimpleNamespace(bound=bound, worst=bound, energy_norm=1.0)
    assert Progress.start(scale).judge(certificate, 1e-3) is expected
