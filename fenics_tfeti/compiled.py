"""C code of the package, compiled when it is first used."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from fenics_tfeti.typing import Array

# No options that change the arithmetic: -ffast-math lets the linker add start-up code that flushes
# small numbers to zero in the whole process.
_OPTIONS = ["-std=gnu11", "-O3", "-fPIC", "-shared"]
_SECONDS = 120


class Unavailable(Exception):
    """There is no compiled code; the text says why."""


def pointer(array: Array) -> ctypes.c_void_p:
    """Return the address of an array, in C's order, for functions in C."""
    assert array.flags.c_contiguous
    # faster than `array.ctypes`
    return ctypes.c_void_p(array.__array_interface__["data"][0])


def cache_folder() -> Path:
    """Return the folder of compiled code: that in which dolfinx keeps its compiled forms."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fenics"


def compiled_library(
    source: Path, options: Sequence[str] = (), libraries: Sequence[str] = (), version: str = ""
) -> ctypes.CDLL:
    """Compile a file with options and libraries, whose version is given, or take what there is.

    A process that compiles it holds a lock that ends with the process; others wait, and take its
    result. The library appears under its name when it is complete. What is there is used in a
    folder that cannot be written, too. Raises `Unavailable`, or an OSError of the folder.
    """
    command = [*_compiler(), *_OPTIONS, *options]
    # that of an environment of conda
    command += [f"-I{sys.prefix}/include", f"-L{sys.prefix}/lib"]
    linked = [f"-l{name}" for name in libraries]
    key = [source.read_text(), *command, *linked, _processor(), version]
    name = hashlib.sha256("\n".join(key).encode()).hexdigest()[:24]
    path = cache_folder() / f"libfenics_tfeti_{name}.so"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path.with_suffix(".lock")):
            if not path.exists():
                _compile(command, source, linked, path)
    return ctypes.CDLL(str(path))


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")[:1]


def _processor() -> str:
    """Return what the compiler's choice of instructions depends on."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.lower().startswith(("flags", "features")):
                return line
    return f"{platform.machine()} {platform.processor()}"


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock on a file; a file system without locks has none, and compiles more than once."""
    import fcntl

    with path.open("w") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _compile(command: list[str], source: Path, linked: list[str], path: Path) -> None:
    """Compile to a file of this process, and rename it."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f"{path.stem}_") as folder:
        output = Path(folder) / path.name
        try:
            done = subprocess.run(
                [*command, str(source), "-o", str(output), *linked],
                capture_output=True,
                text=True,
                timeout=_SECONDS,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise Unavailable(f"the C compiler {command[0]!r} does not run: {error}") from error
        if done.returncode:
            first = next((x for x in done.stderr.splitlines() if "error" in x), "no message")
            raise Unavailable(f"the C compiler {command[0]!r} failed: {first.strip()}")
        os.replace(output, path)
