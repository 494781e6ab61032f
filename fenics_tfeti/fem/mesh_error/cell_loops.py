"""Loops over cells in C: their Neumann problems, and energies of changes of their moments."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np

from fenics_tfeti.compiled import Unavailable, compiled_library, pointer
from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Numbers, Vector

SOURCE = Path(__file__).with_name("cells.c")


@cache
def _library() -> ctypes.CDLL:
    """Return the compiled loops; `InputError` on this rank without a compiler."""
    try:
        library = compiled_library(SOURCE, ["-march=native"])
    except (Unavailable, OSError) as error:
        raise InputError(
            f"the loops of the mesh error cannot be compiled: {error}. They need the C compiler "
            "that compiles forms"
        ) from error
    library.mesh_error_products.restype = ctypes.c_ssize_t
    return library


def _sizes(*sizes: int) -> list[ctypes.c_ssize_t]:
    return [ctypes.c_ssize_t(size) for size in sizes]


def products(A: Vector, lift: Vector, load: Vector, out: tuple[Vector, Vector, Vector]) -> int:
    """Add B'A^{-1}B of cells, B = [lift (w, s), load (k, w, v)], to matrices, gradients, constants.

    They are (k, s, s), (k, s, v) and (k, v); A (k, w, w) is lost. Returns the number of cells
    before the first whose A is not positive definite.
    """
    (k, w, v), s = load.shape, lift.shape[1]
    work = np.empty(w * (s + v))
    arrays = (A, np.ascontiguousarray(lift), np.ascontiguousarray(load), *out, work)
    return int(_library().mesh_error_products(*_sizes(k, w, s, v), *map(pointer, arrays)))


def add_energies(
    energy: Vector, cells: Numbers, rows: Numbers, facets: Numbers, sign: Vector, basis: Vector,
    Q: Vector,
) -> None:  # fmt: skip
    """Add the energies (r, z, z) of changes of moments in blocks with c cells of h facets each.

    `cells` (r, c) are rows of Q (g, s, s), or below zero; `rows` (r, c, h, m) the places of a
    facet's moments among the s of a cell, `facets` (r, c, h) its number in the block, `sign` that
    of the cell's side, `basis` (r, j, m, z) the changes.
    """
    (r, c, h, m), (_, j, _, z) = rows.shape, basis.shape
    numbers = [np.ascontiguousarray(x, dtype=np.intp) for x in (cells, rows, facets)]
    values = [np.ascontiguousarray(x, dtype=float) for x in (sign, basis, Q)]
    arrays = (*numbers, *values, energy, np.empty(2 * h * m * z))
    sizes = _sizes(z, r, c, h, j, m, Q.shape[1])
    _library().mesh_error_energies(*sizes, *map(pointer, arrays))
