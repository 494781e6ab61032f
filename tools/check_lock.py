"""What an environment holds, compared with a lock: python tools/check_lock.py debian|wheel"""

from __future__ import annotations

import re
import sys
import sysconfig
from importlib.metadata import distributions
from pathlib import Path

LOCKS = Path(__file__).parent / "lock"
# the project itself, and the pip that comes with Python
_UNLOCKED = {"fenics-tfeti", "pip"}


def normalised(name: str) -> str:
    """Return the name of a package in the form that is the same for all spellings."""
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, str]:
    """Return the versions of the packages in this environment, without those of the system."""
    folders = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    found = {normalised(d.metadata["Name"]): d.version for d in distributions(path=[*folders])}
    return {name: version for name, version in found.items() if name not in _UNLOCKED}


def locked(text: str) -> dict[str, str]:
    """Return the versions in the text of a lock."""
    pairs = (line.split("==") for line in text.splitlines() if line)
    return {normalised(name): version for name, version in pairs}


def differences(lock: dict[str, str], found: dict[str, str]) -> list[str]:
    """Return a line for each package that is not the same in both."""
    return [
        f"{name}: {lock.get(name, 'none')} in the lock, {found.get(name, 'none')} installed"
        for name in sorted(lock.keys() | found.keys())
        if lock.get(name) != found.get(name)
    ]


if __name__ == "__main__":
    file = LOCKS / f"{sys.argv[1]}-{sys.version_info.major}.{sys.version_info.minor}.txt"
    lines = differences(locked(file.read_text()), installed())
    print("\n".join(lines) or f"all packages are those of {file.name}")
