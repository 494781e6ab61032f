from __future__ import annotations

import time

import pytest

from fenics_tfeti.feti import Timer


def test_phases_add_up():
    timer = Timer()
    for _ in range(2):
        with timer.phase("sleep"):
            time.sleep(0.02)
    with timer.phase("nothing"):
        pass
    assert list(timer.seconds) == ["sleep", "nothing"]
    assert 0.04 <= timer.seconds["sleep"] < 1.0
    assert 0.0 <= timer.seconds["nothing"] < 0.02


def test_time_counts_where_the_block_fails():
    timer = Timer()
    with pytest.raises(ValueError, match="bad"), timer.phase("failing"):
        raise ValueError("bad")
    assert "failing" in timer.seconds
