"""Factors by CHOLMOD, packed for solves that are compiled for them (`supernodal.c`)."""

from __future__ import annotations

import ctypes
import weakref
from typing import Any

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.compiled import pointer
from fenics_tfeti.errors import OutOfMemory
from fenics_tfeti.feti.factors.threads import one_thread
from fenics_tfeti.feti.tolerances import rounding
from fenics_tfeti.typing import Indices, Numbers, Operator, Vector

# right-hand sides that are solved for at once are at most as many
_LANES = 8
# springs of the last matrix of a name that serve again, at most
_HELD = 32
# a kept ordering serves while it leads to so many times the entries at most
_SIMILAR = 1.2


class NotDefinite(Exception):
    """CHOLMOD has met a pivot that is not positive."""


def out_of_memory(package: str, order: int) -> OutOfMemory:
    """Return the error that there is no memory for a factor of a matrix."""
    return OutOfMemory(
        f"there is not enough memory for the factor of a matrix of order {order} by {package}. "
        "Take more ranks on more machines; without them, subdomains with fewer unknowns "
        "('subdomain_size') have smaller factors, and larger ones a smaller coarse problem"
    )


class Ordering:
    """The ordering of the last matrix of a subdomain, its number of entries and its springs.

    A similar matrix, such as that of the next Newton step, may have a few other entries. What the
    ordering is `of`, the size and the way to find it, has to be the same.
    """

    def __init__(self) -> None:
        self._of: tuple[int, ...] | None = None
        self._kept: tuple[Indices, float, Indices]

    def find(self, of: tuple[int, ...]) -> tuple[Indices, float, Indices]:
        """Return a copy of an ordering, its entries and springs; room and 0 if there is none."""
        if self._of != of:
            none: Indices = np.zeros(0, dtype=np.int32)
            return np.empty(of[0], dtype=np.int32), 0.0, none
        ordering, entries, held = self._kept
        return ordering.copy(), entries, held[: held.size * (held.size <= _HELD)]

    def keep(self, of: tuple[int, ...], ordering: Indices, entries: float, held: Indices) -> None:
        """Keep an ordering in place of the last one."""
        self._of, self._kept = of, (ordering, entries, held)


# by name of the subdomain
Orderings = dict[int, Ordering]


class SupernodalFactor:
    """The Cholesky factor of a sparse symmetric positive definite matrix.

    `width` unknowns, one after the other, are coupled alike: those of a node, which is ordered as
    a whole. CHOLMOD chooses the smallest of some orderings: `methods` is its number of them. The
    `last` ordering is taken while it is as good, and this one kept there. `NotDefinite` if the
    matrix is not positive definite. Where a pivot is not positive, a `spring` is added to its
    diagonal, in place, at the unknown that moves most in a displacement of negative energy, up to
    `most` times. The unknowns are `held` then, first those of the last matrix.
    """

    negative = 0

    def __init__(
        self,
        library: ctypes.CDLL,
        matrix: sp.csr_matrix,
        width: int = 1,
        methods: int = 0,
        last: Ordering | None = None,
        spring: float = 0.0,
        most: int = 0,
    ) -> None:
        rows = matrix if matrix.has_sorted_indices else matrix.sorted_indices()
        size = rows.shape[0]
        self._library = library
        self._places: Indices = np.empty(size, dtype=np.int32)
        arrays = [x.astype(np.int32, copy=False) for x in (rows.indptr, rows.indices)]
        arrays.append(rows.data.astype(np.float64, copy=False))
        figures = np.zeros(2, dtype=np.int64)
        last, of = last or Ordering(), (size, width, methods, most)
        ordering, entries, held = last.find(of)
        count = ctypes.c_int(held.size)
        held = np.append(held, np.empty(most, dtype=np.int32))
        limit = ctypes.c_double(_SIMILAR * entries)
        with one_thread():
            address = library.supernodal_factor(
                size, *map(pointer, arrays), width, methods, ctypes.byref(limit),
                pointer(ordering), pointer(self._places), pointer(figures),
                ctypes.c_double(spring), pointer(held), ctypes.byref(count), most,
            )  # fmt: skip
        self.held: Indices = held[: count.value]
        is_new = limit.value != _SIMILAR * entries
        last.keep(of, ordering, limit.value if is_new else entries, self.held)
        if not address and not figures[0]:
            raise out_of_memory("cholmod", size)
        if not address:
            raise NotDefinite("a pivot is not positive")
        self._factor = ctypes.c_void_p(address)
        self.entries, longest = map(int, figures)
        self._room = size + longest
        weakref.finalize(self, library.supernodal_free, self._factor).atexit = False

    def solve(self, b: Vector) -> Vector:
        """Solve for a vector (n,)."""
        return self._solved(self._places, np.ascontiguousarray(b, dtype=np.float64)[None])[0]

    def solve_columns(self, b: Vector) -> Vector:
        """Solve for the columns of a matrix (n, k) in Fortran order."""
        return self._solved(self._places, np.ascontiguousarray(b.T, dtype=np.float64)).T

    def between(self, unknowns: Numbers) -> Operator:
        """Return the inverse between some unknowns, for the rows of a matrix (k, b)."""
        places = self._places[unknowns]
        return lambda rows: self._solved(places, np.ascontiguousarray(rows, dtype=np.float64))

    def _solved(self, places: Indices, rows: Vector) -> Vector:
        result = np.empty_like(rows)
        work = np.empty(self._room * (1 if len(rows) == 1 else _LANES))
        self._library.supernodal_solve(
            self._factor, places.size, pointer(places), len(rows), pointer(rows),
            pointer(result), pointer(work),
        )  # fmt: skip
        return result


class DowndatedFactor:
    """The inverse A^{-1} + Y C^{-1} Y' of A - UU', with Y = A^{-1} U and C = I - U'Y.

    By Sylvester's law A and C have the negative eigenvalues of A - UU'. `NotDefinite` if C is
    singular. The factor of A is by any package.
    """

    def __init__(self, factor: Any, U: Vector) -> None:
        self.of, self.entries = factor, factor.entries
        self._Y = factor.solve_columns(np.asfortranarray(U))
        product = U.T @ self._Y
        values, vectors = np.linalg.eigh(np.eye(U.shape[1]) - product)
        if np.abs(values).min(initial=np.inf) <= rounding(1.0 + np.abs(product).max(initial=0.0)):
            raise NotDefinite("the downdated matrix is singular")
        self.negative = factor.negative + int(np.count_nonzero(values < 0.0))
        self._C_inverse = (vectors / values) @ vectors.T

    def solve(self, b: Vector) -> Vector:
        """Solve for a vector (n,)."""
        return self.of.solve(b) + self._Y @ (self._C_inverse @ (self._Y.T @ b))

    def solve_columns(self, b: Vector) -> Vector:
        """Solve for the columns of a matrix (n, k) in Fortran order."""
        return self.of.solve_columns(b) + self._Y @ (self._C_inverse @ (self._Y.T @ b))

    def between(self, unknowns: Numbers) -> Operator:
        """Return the inverse between some unknowns, for the rows of a matrix (k, b)."""
        inverse, Y = self.of.between(unknowns), self._Y[unknowns]
        Y_C = Y @ self._C_inverse
        return lambda rows: inverse(rows) + (rows @ Y_C) @ Y.T
