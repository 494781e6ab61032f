"""The environment holds what its lock says."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
from check_lock import LOCKS, differences, installed, locked

LOCK = Path(sys.prefix) / "lock.txt"


def test_environment_holds_what_is_locked():
    if not LOCK.is_file() or not LOCK.read_text():
        pytest.skip("this environment was made without a lock")
    assert LOCK.read_text() in [file.read_text() for file in LOCKS.glob("*.txt")]
    assert differences(locked(LOCK.read_text()), installed()) == []


@pytest.mark.once
def test_differences_are_named():
    lock = locked("Some_Package==1.0\nother==2\nsame==3\n")
    assert differences(lock, {"some-package": "1.1", "same": "3", "new": "4"}) == [
        "new: none in the lock, 4 installed",
        "other: 2 in the lock, none installed",
        "some-package: 1.0 in the lock, 1.1 installed",
    ]
