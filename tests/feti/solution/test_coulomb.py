"""When the fixed point on the slip bounds is given up."""

from __future__ import annotations

import pytest

from fenics_tfeti.feti.solution.coulomb import _failure


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.89])
def test_steps_that_contract_go_on(ratio):
    changes = [ratio**k for k in range(12)]
    assert all(_failure(changes[:k]) == "" for k in range(13))


@pytest.mark.parametrize("ratio", [0.91, 1.0, 1.3])
def test_fifteen_steps_that_do_not_contract_are_enough(ratio):
    changes = [0.5 * ratio**k for k in range(16)]
    assert _failure(changes[:15]) == ""
    assert f"a factor of {ratio:.2f} a step only" in _failure(changes)


def test_one_large_change_is_no_failure():
    assert _failure([1.0, 0.5, 0.2, 0.4, 0.1, 0.05]) == ""
