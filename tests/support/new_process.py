"""Python code in a process of its own, which has imported nothing yet, and runs on ranks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def run_python(code: str, *arguments: str, timeout: int = 100) -> str:
    """Run code where the modules of tests/support can be imported; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        timeout=timeout,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def mpirun() -> list[str]:
    """Return the launcher of the MPI library that this Python's mpi4py loads."""
    own = Path(sys.prefix) / "bin" / "mpiexec"
    command = str(own) if own.exists() else "/usr/bin/mpirun"
    version = subprocess.run([command, "--version"], capture_output=True, text=True).stdout
    return [command, "--oversubscribe"] if "Open MPI" in version else [command]
