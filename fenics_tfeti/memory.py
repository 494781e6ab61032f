"""Memory that the C library keeps after it was freed."""

from __future__ import annotations

import ctypes


def return_free_memory() -> None:
    """Give memory that is free back to the system, where the C library can (glibc).

    Reading and distributing a mesh, and the assembly, leave more of it than what they have made;
    in pieces, of which large arrays take none.
    """
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)
