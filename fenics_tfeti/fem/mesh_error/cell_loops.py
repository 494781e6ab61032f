"""Loops over cells in C: tractions around nodes, Neumann problems, conjugate gradients."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np

from fenics_tfeti.compiled import Unavailable, compiled_library, pointer
from fenics_tfeti.errors import InputError
from fenics_tfeti.typing import Array, Indices, Mask, Vector

SOURCE = Path(__file__).with_name("cells.c")
# numbers that are computed with at once, as in the C code
PACK = 8


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
    library.mesh_error_number.restype = ctypes.c_ssize_t
    return library


def _call(name: str, *arguments: object) -> int:
    """Call a function with sizes, numbers, arrays and structures; arrays are in C's order."""
    converted = [_converted(argument) for argument in arguments]
    return int(getattr(_library(), f"mesh_error_{name}")(*converted))


def _converted(argument: object) -> object:
    if isinstance(argument, np.ndarray):
        return pointer(argument)
    if isinstance(argument, ctypes.Structure):
        return ctypes.byref(argument)
    if isinstance(argument, float):
        return ctypes.c_double(argument)
    assert isinstance(argument, int)
    return ctypes.c_ssize_t(argument)


def _int32(values: Array) -> Indices:
    return np.ascontiguousarray(values, dtype=np.int32)


def ordered(keys: Array, count: int) -> tuple[Indices, Indices]:
    """Return the places of keys below a count, by ascending key, and the first one (count + 1,)."""
    keys = _int32(keys).ravel()
    order, first = np.empty(keys.size, dtype=np.int32), np.empty(count + 1, dtype=np.int32)
    _call("order", keys.size, count, keys, order, first)
    return order, first


def balance_nodes(
    skipped: Mask,
    pairs: tuple[Indices, Indices],
    tables: tuple[int, int, Indices],
    facets: tuple[int, Indices, Mask],
    force: Vector,
    own: Vector,
    out: Vector,
) -> Vector:
    """Find the moments `out` (rows, d, v) in balance with forces, nearest to those of `own`.

    Moments at nodes that are skipped (nodes,) do not change. `pairs` of a cell and a node are all,
    ordered by node, and the first of each node (nodes + 1,); `force` (pairs, d, v) are theirs. Of
    `tables` (n, stride, offset (n, h)) the rows of the moments of pair p are p // n * stride +
    offset[p % n], and of `facets` (t, number, free (., d)) row r is on facet number[r // t].
    Returns the imbalance (nodes, d).
    """
    (order, first), (n, stride, offset), (t, number, free) = pairs, tables, facets
    _, d, v = force.shape
    h, most = offset.shape[1], int(np.diff(first).max(initial=0))
    imbalance = np.zeros((first.size - 1, d))
    work = np.empty(most * (most + 2 * h * d + 2 * d * v))
    numbers = np.empty(most * (4 * h + 2), dtype=np.int32)
    offset, number, free = _int32(offset), _int32(number), np.ascontiguousarray(free)
    force = np.ascontiguousarray(force)
    _call(
        "nodes", first.size - 1, skipped, first, order, n, stride, h, offset, t, number, free, d, v,
        force, own, out, imbalance, most, work, numbers,
    )  # fmt: skip
    return imbalance


def subtract_internal(number: Indices, A: Vector, u: Vector, load: Vector) -> Vector:
    """Subtract Au from loads (k, w, v) for displacements u (k, w), and return u'Au (k,).

    Cell k has the matrix A (., w, w) of a number.
    """
    k, w, v = load.shape
    energy = np.empty(k)
    _call("internal", k, w, v, number, A, np.ascontiguousarray(u), load, energy)
    return energy


def hold_motions(A: Vector, x: Vector, limit: float) -> Mask:
    """Add stiffness against rigid motions to upper triangles of A (k, w, w), by nodes x (k, n, d).

    Cells that may resist motions, by more than a limit relative to the trace, are returned (k,)
    instead.
    """
    k, w, _ = A.shape
    resisted = np.zeros(k, dtype=bool)
    x = np.ascontiguousarray(x)
    _call("hold", k, w, x.shape[2], limit, x, A, resisted, np.empty(7 * w))
    return resisted


def products(
    members: tuple[Indices, Indices],
    A: Vector,
    lift: Vector,
    load: Vector,
    out: tuple[Vector, Vector, Vector],
) -> int:
    """Compute B'A^{-1}B of cells, B = [lift (w, s), load (k, w, v)]: see `CellEnergies`.

    `members` are the cells of each class of cells with the same matrix, and the first of each
    class; the upper triangles of A (classes, w, w) are used, and lost. Returns the number of
    classes before the first whose A is not positive definite.
    """
    (_, w, v), s = load.shape, lift.shape[1]
    stride = (s + PACK * v + PACK - 1) // PACK * PACK
    order, first = members
    arrays = first, order, A, np.ascontiguousarray(lift), np.ascontiguousarray(load), *out
    return _call("products", len(A), w, s, v, stride, *arrays, np.empty(w * stride))


def numbered(keys: Array, nodes: Array) -> tuple[Indices, Indices, Indices]:
    """Return keys (g, f) numbered from zero, sides (facets, 2), and orders of nodes (g, f, t).

    Sides are the first place of each key and another one, or -1. Orders are those of the numbers of
    the nodes.
    """
    keys, nodes = _int32(keys), _int32(nodes)
    (g, f), t = keys.shape, nodes.shape[2]
    number, side = np.empty((g, f), dtype=np.int32), np.empty((g * f, 2), dtype=np.int32)
    order = np.empty((g, f, t), dtype=np.int32)
    seen = np.zeros(int(keys.max(initial=-1)) + 1, dtype=np.int32)
    count = _call("number", g, f, t, keys, nodes, seen, number, side, order)
    return number, side[:count].copy(), order


class _Cells(ctypes.Structure):
    _fields_ = [(name, ctypes.c_ssize_t) for name in ("cells", "facets", "f", "t", "d", "v")]
    _fields_ += [(name, ctypes.c_void_p) for name in ("number", "facet", "place", "side")]
    _fields_ += [(name, ctypes.c_void_p) for name in ("Q", "middle")]
    _fields_ += [("length", ctypes.c_double)]


class CellLoops:
    """Loops over some cells, whose moments are given on facets in the order of nodes' numbers.

    `facet` (g, f), `side` (facets, 2) and `place` (g, f, t) are those of `numbered`; cell k has the
    matrix Q (., s, s) of a number, of s = f * m moments. Facets have middles (facets, d); lengths
    in resultants are relative to `length` [m].
    """

    def __init__(
        self,
        facet: Indices,
        side: Indices,
        place: Indices,
        matrices: tuple[Indices, Vector],
        middle: Vector,
        length: float,
        v: int,
    ) -> None:
        (g, f, t), (facets, d) = place.shape, middle.shape
        number, Q = matrices
        self._kept = arrays = (number, facet, place, side, Q, middle)
        assert all(array.flags.c_contiguous for array in arrays)
        addresses = (array.ctypes.data for array in arrays)
        self._cells = _Cells(g, facets, f, t, d, v, *addresses, length)
        self._cell_shape, self._facet_shape = (g, f * t * d, v), (facets, t * d, v)
        self._resultants = (3, 6)[d - 2]
        self._work = np.empty(f * t * d * v)

    def to_facets(self, values: Vector) -> Vector:
        """Sum up values (g, s, v) of cells on facets (facets, m, v)."""
        total = np.empty(self._facet_shape)
        _call("to_facets", self._cells, values, total)
        return total

    def stiffness(self, p: Vector) -> Vector:
        """Return Qp (g, s, v) for changes p (facets, m, v) of the moments."""
        Qp = np.empty(self._cell_shape)
        _call("stiffness", self._cells, p, Qp, self._work)
        return Qp

    def advance(
        self, alpha: Vector, p: Vector, Qp: Vector, gradient: Vector, energy: Vector
    ) -> None:
        """Add the change of energies (g, v) and gradients by steps alpha (v,) along p to these."""
        _call("advance", self._cells, alpha, p, Qp, gradient, energy, self._work)

    def facet_tractions(self, x: Vector) -> tuple[Vector, Vector]:
        """Return tractions W (facets, m, PACK) with unit resultants, and Z (facets, z, m) without.

        Facets have nodes x (facets, t, d).
        """
        (facets, m, _), n = self._facet_shape, self._resultants
        W, Z = np.empty((facets, m, PACK)), np.empty((facets, m - n, m))
        _call("facets", self._cells, np.ascontiguousarray(x), W, Z, np.empty((m + 1) * n + m))
        return W, Z

    def walk(
        self, first: Indices, order: Indices, pair: Array, may_end: Mask
    ) -> tuple[Indices, Vector, Array, Vector]:
        """Walk around rings: the places (cells, e) of each are those of an order, from a first on.

        In each place the ring passes two facets of the cell, pair (e, 2). Returns the facets
        (places, 2) before and after, the sense of a force there, how forces pass, and middles.
        """
        rings = first.size - 1
        cell, facet = np.empty(order.size, np.int32), np.empty((order.size, 2), np.int32)
        sense, how = np.empty(order.size), np.empty(rings, dtype=np.uint8)
        out = facet, sense, how, np.empty((rings, self._cells.d))
        _call("walk", self._cells, rings, len(pair), first, order, pair, may_end, cell, *out)
        return out

    def inverses(
        self,
        rings: tuple[Indices, Indices, Array, Vector],
        may_change: Mask,
        tractions: tuple[Vector, Vector],
        shift: float,
    ) -> tuple[Vector, Vector]:
        """Return the inverses of the energies on facets (facets, z, z) and around rings (r, n, n).

        `rings` are those at the entities of cells (g, e), the facets pair (e, 2) at each, how
        forces pass, and middles; `tractions` W and Z.
        """
        (entity, pair, how, _), (facets, m, _), n = rings, self._facet_shape, self._resultants
        z, s = m - n, self._cell_shape[1]
        out = np.empty((facets, z, z)), np.empty((how.size, n, n))
        f = s // m
        work = np.empty((s + f * s) * PACK + z * m + m * m)
        arrays = entity, pair, how, may_change, rings[3], *tractions
        _call("inverses", self._cells, how.size, entity.shape[1], *arrays, shift, *out, work)
        return out

    def preconditioned(self, residual: Vector, rings: tuple[Array, ...]) -> Vector:
        """Return the sum over facets and rings of what their inverses give for a residual.

        `rings` are first, facet, sense, how, middle, W, Z and both inverses.
        """
        result = np.empty(self._facet_shape)
        sums = np.empty(2 * self._resultants * len(residual) + self._facet_shape[1])
        _call("precondition", self._cells, len(rings[3]), *rings, residual, result, sums)
        return result
