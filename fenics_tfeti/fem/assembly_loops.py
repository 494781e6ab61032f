"""Loops over cells in C: kernels of forms, the pattern of a stiffness matrix, and its numbers."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np

from fenics_tfeti.compiled import Unavailable, compiled_library, pointer
from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Array, Indices, Numbers, Vector

SOURCE = Path(__file__).with_name("assembly.c")
_size = ctypes.c_ssize_t


def _pointers(*arrays: Array) -> list[ctypes.c_void_p]:
    return [pointer(array) for array in arrays]


@cache
def assembly_library() -> ctypes.CDLL:
    """Return the compiled loops; `InputError` on this rank without a compiler."""
    try:
        return compiled_library(SOURCE)
    except (Unavailable, OSError) as error:
        raise InputError(
            f"the assembly cannot be compiled: {error}. It needs the C compiler that compiles forms"
        ) from error


def integrate(
    kernel: int,
    arguments: int,
    rows: Numbers,
    tensors: Vector,
    coefficients: Vector,
    constants: Vector,
    coordinates: Vector,
    facets: Indices | None,
) -> None:
    """Add an integral over some cells, or over a facet of each, to their element tensors.

    The kernel is an address and its number of arguments. For rows, tensors and the rest see
    `_compat.CompiledForm.add_element_tensors`.
    """
    rows = np.ascontiguousarray(rows, dtype=np.intp)
    coefficients, coordinates = map(np.ascontiguousarray, (coefficients, coordinates))
    sizes = [_size(x.size // len(tensors)) for x in (tensors, coefficients, coordinates)]
    assembly_library().assembly_integrate(
        ctypes.c_void_p(kernel), arguments, _size(rows.size), pointer(rows),
        pointer(tensors), sizes[0], pointer(coefficients), sizes[1], pointer(constants),
        pointer(coordinates), sizes[2], None if facets is None else pointer(facets),
    )  # fmt: skip


def neighbours_of_nodes(table: Indices, nodes: int) -> tuple[Indices, Indices]:
    """Return the end (nodes + 1,) of each node's neighbours, and these, by ascending number.

    Neighbours are in the same row of the table (m, v) of the nodes of cells.
    """
    cells, vertices = table.shape
    ends = np.empty(nodes + 1, dtype=np.int32)
    neighbours = np.empty(table.size * vertices, dtype=np.int32)
    work = np.empty(2 * nodes + table.size, dtype=np.int32)
    assembly_library().assembly_neighbours(
        nodes, _size(cells), vertices, *_pointers(table, ends, neighbours, work)
    )
    return ends, neighbours[: ends[-1]].copy()


def block_format(ends: Indices, neighbours: Indices, size: int) -> tuple[Indices, Indices]:
    """Return the ends and columns of the CSR format of blocks between nodes and neighbours."""
    nodes = ends.size - 1
    indptr = np.empty(nodes * size + 1, dtype=np.int32)
    indices = np.empty(neighbours.size * size**2, dtype=np.int32)
    assembly_library().assembly_format(nodes, size, *_pointers(ends, neighbours, indptr, indices))
    return indptr, indices


def add_matrices(
    table: Indices, ends: Indices, neighbours: Indices, matrices: Vector, data: Vector
) -> None:
    """Add matrices (m, v * b, v * b) of cells to the numbers of a matrix in that format."""
    cells, vertices = table.shape
    assembly_library().assembly_add(
        _size(cells), vertices, matrices.shape[1] // vertices,
        *_pointers(table, ends, neighbours, matrices, data),
    )  # fmt: skip
