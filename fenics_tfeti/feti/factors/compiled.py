"""The C code for solves with CHOLMOD's factors, compiled when it is first used."""

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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from petsc4py import PETSc

SOURCE = Path(__file__).with_name("supernodal.c")

# No options that change the arithmetic: -ffast-math lets the linker add start-up code that flushes
# small numbers to zero in the whole process.
_OPTIONS = ["-std=gnu11", "-O3", "-march=native", "-fPIC", "-shared"]
_SECONDS = 120


class Unavailable(Exception):
    """There is no compiled code; the text says why."""


def cache_folder() -> Path:
    """Return the folder of compiled code: that in which dolfinx keeps its compiled forms."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fenics"


@cache
def supernodal_library() -> tuple[ctypes.CDLL | None, str]:
    """Return the compiled code, or None and the reason why there is none.

    A process that compiles it holds a lock that ends with the process; others wait, and take its
    result. The library appears under its name when it is complete.
    """
    try:
        return _supernodal_library(), ""
    except (Unavailable, OSError) as error:
        return None, str(error)


def _supernodal_library() -> ctypes.CDLL:
    command = [*_compiler(), *_OPTIONS]
    # that of an environment of conda
    command += [f"-I{sys.prefix}/include", f"-L{sys.prefix}/lib"]
    key = [SOURCE.read_text(), *command, _processor(), _version_of_cholmod()]
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    name = hashlib.sha256("\n".join(key).encode()).hexdigest()[:24]
    path = folder / f"libfenics_tfeti_{name}.so"
    with _locked(path.with_suffix(".lock")):
        if not path.exists():
            _compile(command, path)
    library = ctypes.CDLL(str(path))
    if not library.supernodal_is_usable():
        raise Unavailable("cholmod.h is of another version than the library that PETSc uses")
    library.supernodal_factor.restype = ctypes.c_void_p
    return library


def _compiler() -> list[str]:
    return shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")[:1]


def _processor() -> str:
    """Return what the compiler's choice of instructions depends on."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.lower().startswith(("flags", "features")):
                return line
    return f"{platform.machine()} {platform.processor()}"


def _version_of_cholmod() -> str:
    # the search for a symbol goes through all libraries that PETSc is linked with
    library = ctypes.CDLL(PETSc.__file__)
    if not hasattr(library, "cholmod_version"):
        raise Unavailable("PETSc has no CHOLMOD in a library of its own")
    version = (ctypes.c_int * 3)()
    library.cholmod_version(version)
    return ".".join(map(str, version))


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock on a file; a file system without locks has none, and compiles more than once."""
    import fcntl

    with path.open("w") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _compile(command: list[str], path: Path) -> None:
    """Compile to a file of this process, and rename it."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f"{path.stem}_") as folder:
        output = Path(folder) / path.name
        try:
            done = subprocess.run(
                [*command, str(SOURCE), "-o", str(output), "-lcholmod"],
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
