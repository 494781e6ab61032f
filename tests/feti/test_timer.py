from __future__ import annotations

from mpi4py import MPI

import pytest

from fenics_tfeti.feti import Timer


def timer_at(*times: float) -> Timer:
    """Return a timer whose clock shows these times, one after the other."""
    return Timer(clock=iter(times).__next__)


def test_time_counts_where_the_block_fails():
    timer = timer_at(1.0, 4.0)
    with pytest.raises(ValueError, match="bad"), timer.phase("failing"):
        raise ValueError("bad")
    assert timer.seconds == {"failing": 3.0}


def test_phases_and_laps_add_up_to_the_total():
    timer = timer_at(0.0, 2.0, 10.0, 11.0, 20.0, 24.0)
    laps = []
    for names in (["long"], ["short", "long"]):
        for name in names:
            with timer.phase(name):
                pass
        laps.append(timer.lap(MPI.COMM_SELF))
    assert laps == [2.0, 5.0]
    assert timer.seconds == {"long": 6.0, "short": 1.0}
    assert timer.slowest(MPI.COMM_SELF) == {"long": 6.0, "short": 1.0, "total": 7.0}
    timer.restart()
    assert timer.lap(MPI.COMM_SELF) == 0.0 and not timer.seconds
