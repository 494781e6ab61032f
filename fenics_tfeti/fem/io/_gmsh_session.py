"""Sessions of Gmsh: opened and closed without effect on the user's own session."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fenics_tfeti.errors import InputError

# the point of the last double click on a graph of the graphical interface
_UNUSED_OPTION = "PostProcessing.DoubleClickedGraphPointX"


def import_gmsh() -> Any:
    """Import the Python module of Gmsh, and keep the handler of Ctrl-C that it may replace."""
    try:
        with _interrupt_handler_kept():
            import gmsh
    except (ImportError, OSError) as error:  # OSError: its shared library is missing
        raise ImportError(
            f"reading a .msh file needs the Python module gmsh ({error}); install it with "
            "'apt install python3-gmsh' (Debian, Ubuntu) or 'pip install gmsh'"
        ) from error
    return gmsh


@contextmanager
def opened_file(gmsh: Any, path: Path) -> Iterator[None]:
    """Open a mesh file as the current Gmsh model; close it and restore Gmsh's state at the end."""
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no mesh file '{path}' (looked in {Path.cwd()}); check the path, or make "
            "the file with Gmsh first"
        )
    with path.open("rb") as file:
        if not file.read(1024).lstrip().startswith(b"$"):
            raise InputError(f"{path} is not a Gmsh mesh file: it does not start with $MeshFormat")
    with _session(gmsh):
        gmsh.model.add("fenics_tfeti.read_msh")
        try:
            gmsh.merge(str(path))
        except Exception as error:  # Gmsh raises no class of its own
            raise InputError(
                f"Gmsh cannot read {path} ({error}); save it again as a mesh of version 4.1, or "
                "update Gmsh"
            ) from error
        yield


@contextmanager
def _session(gmsh: Any) -> Iterator[None]:
    """Open a Gmsh session without terminal output, or use the user's and restore its state."""
    with _interrupt_handler_kept():
        opened_here = _open(gmsh)
        terminal = gmsh.option.getNumber("General.Terminal")
        current = gmsh.model.getCurrent()
        models = len(gmsh.model.list())
        gmsh.option.setNumber("General.Terminal", 0)
        try:
            yield
        finally:
            if opened_here:
                gmsh.finalize()
            else:
                if len(gmsh.model.list()) > models:
                    gmsh.model.remove()
                gmsh.model.setCurrent(current)
                gmsh.option.setNumber("General.Terminal", terminal)


def _open(gmsh: Any) -> bool:
    """Open a session if the user has none; tell whether it did."""
    if hasattr(gmsh, "isInitialized"):
        if gmsh.isInitialized():
            return False
        gmsh.initialize(readConfigFiles=False)
        return True
    # Gmsh 4.8 may end the process when it is asked anything outside a session, and does not take
    # the arguments if a session is open: an option that nobody sets tells whether it took them
    with _stderr_closed():
        gmsh.initialize(["gmsh", "-setnumber", _UNUSED_OPTION, "1"], readConfigFiles=False)
    return bool(gmsh.option.getNumber(_UNUSED_OPTION) == 1)


@contextmanager
def _interrupt_handler_kept() -> Iterator[None]:
    """Restore the handler of Ctrl-C, which Gmsh replaces by one that ends the process."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


@contextmanager
def _stderr_closed() -> Iterator[None]:
    """Discard what a C library writes to the standard error stream."""
    copy = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(copy, 2)
        os.close(copy)
