"""The C code for solves with CHOLMOD's factors."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from fenics_tfeti.compiled import Unavailable, compiled_library
from fenics_tfeti.petsc import PETSc

SOURCE = Path(__file__).with_name("supernodal.c")


@cache
def supernodal_library() -> tuple[ctypes.CDLL | None, str]:
    """Return the compiled code, or None and the reason why there is none."""
    try:
        return _supernodal_library(), ""
    except (Unavailable, OSError) as error:
        return None, str(error)


def _supernodal_library() -> ctypes.CDLL:
    library = compiled_library(SOURCE, ["-march=native"], ["cholmod"], _version_of_cholmod())
    if not library.supernodal_is_usable():
        raise Unavailable("cholmod.h is of another version than the library that PETSc uses")
    library.supernodal_factor.restype = ctypes.c_void_p
    return library


def _version_of_cholmod() -> str:
    if PETSc is None:
        raise Unavailable("there is no petsc4py")
    # the search for a symbol goes through all libraries that PETSc is linked with
    library = ctypes.CDLL(PETSc.__file__)
    if not hasattr(library, "cholmod_version"):
        raise Unavailable("PETSc has no CHOLMOD in a library of its own")
    version = (ctypes.c_int * 3)()
    library.cholmod_version(version)
    return ".".join(map(str, version))
