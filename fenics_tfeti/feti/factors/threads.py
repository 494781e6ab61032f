"""Work of libraries on the thread that calls them: the ranks share the processors."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from fenics_tfeti.petsc import PETSc


@cache
def openmp(path: str) -> ctypes.CDLL | None:
    """Return the functions of the OpenMP library that a library is linked with.

    None if it is linked with none.
    """
    # the search for a symbol goes through all libraries that this one is linked with
    library = ctypes.CDLL(path)
    return library if hasattr(library, "omp_set_max_active_levels") else None


@contextmanager
def one_thread(path: str = "") -> Iterator[None]:
    """Let OpenMP's parallel regions run on one thread, whatever number they ask for.

    CHOLMOD 3 asks for four in its supernodal factorisation, whatever OMP_NUM_THREADS is. A factor
    of some thousand unknowns has many regions of a few microseconds, and on two processors the
    threads wait for each other most of the time: it takes three times as long. The path is that of
    a library that is linked with what uses OpenMP, by default PETSc's.
    """
    library = openmp(path or PETSc.__file__)
    if library is None:
        yield
        return
    levels = library.omp_get_max_active_levels()
    library.omp_set_max_active_levels(0)
    try:
        yield
    finally:
        library.omp_set_max_active_levels(levels)
