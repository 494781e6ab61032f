"""Communication between ranks: collective errors, gathered arrays, the directory of numbers.

Everything here belongs to the set-up; the directory works on integer keys such as global node
numbers. What the iterations exchange is in `fenics_tfeti.feti.constraints.dual_layout`.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Directory",
    "concatenate_buffers",
    "concatenate_ranks",
    "first_of_rank",
    "raise_collectively",
]

Keys = NDArray[np.int64]
Array = NDArray[Any]


@contextmanager
def raise_collectively(comm: MPI.Comm) -> Iterator[None]:
    """Make an error in a block *without communication* an error on all ranks.

    Collective: no rank leaves the block before the others, so none waits for one that has raised.
    All raise the error of the lowest rank that has one, which there keeps its traceback. What
    cannot be pickled arrives on the others as a RuntimeError with its name and message.

    Parameters
    ----------
    comm : MPI.Comm
        The ranks.

    Examples
    --------
    >>> with raise_collectively(MPI.COMM_WORLD):
    ...     if MPI.COMM_WORLD.rank == 0:
    ...         raise ValueError("bad input")
    Traceback (most recent call last):
    ValueError: bad input
    """
    own: Exception | None = None
    try:
        yield
    except Exception as caught:
        own = caught
    for rank, error in enumerate(comm.allgather(_portable(own))):
        if error is not None:
            raise own if own is not None and rank == comm.rank else error


def _portable(error: Exception | None) -> Exception | None:
    """Return an exception that survives pickling."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def concatenate_ranks(comm: MPI.Intracomm, part: Array) -> Array:
    """Return the ranks' arrays one behind the other, on every rank."""
    return np.concatenate(comm.allgather(part))


def concatenate_buffers(comm: MPI.Intracomm, *parts: Array) -> list[Array]:
    """As `concatenate_ranks`, for vectors of one length and numbers of one kind; no pickling."""
    counts = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([parts[0].size]), counts)
    whole = [np.empty(int(counts.sum()), dtype=part.dtype) for part in parts]
    for part, result in zip(parts, whole, strict=True):
        comm.Allgatherv(np.ascontiguousarray(part), [result, counts.tolist()])
    return whole


def first_of_rank(comm: MPI.Intracomm, count: int) -> tuple[int, int]:
    """Return the number of things on lower ranks and on all ranks."""
    counts = comm.allgather(count)
    return sum(counts[: comm.rank]), sum(counts)


class Directory:
    """Integer keys spread over the ranks by number; each place knows who holds its keys.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    keys : (m,) integer array
        The distinct keys that this rank holds.

    Attributes
    ----------
    keys : (d,) integer array
        The keys whose place is this rank, ascending.
    """

    def __init__(self, comm: MPI.Intracomm, keys: Keys) -> None:
        self._comm = comm
        limit = comm.allreduce(int(keys.max(initial=-1)), MPI.MAX) + 1
        self._chunk = max(1, -(-limit // comm.size))
        arrived = comm.alltoall(self._by_place(keys, [])[0])
        ranks = np.repeat(np.arange(comm.size), [rows[0].size for rows in arrived])
        held = np.concatenate([rows[0] for rows in arrived])
        order = np.argsort(held, kind="stable")
        self._held, self._holders = held[order], ranks[order]
        self.keys: Keys = np.unique(held)

    def _by_place(
        self, keys: Keys, data: list[Array]
    ) -> tuple[list[tuple[Array, ...]], NDArray[np.intp]]:
        """Split rows (key, data...) by the keys' places; also return the order used."""
        # keys that nobody holds may lie beyond the limit; the last place answers for them
        place = np.clip(keys // self._chunk, 0, self._comm.size - 1)
        order = np.argsort(place, kind="stable")
        cuts = np.searchsorted(place[order], np.arange(1, self._comm.size))
        columns = [np.split(column[order], cuts) for column in (keys, *data)]
        return list(zip(*columns, strict=True)), order

    def collect(self, keys: Keys, *data: Array) -> tuple[Array, ...]:
        """Send rows (key, data...) to the keys' places; return the columns that arrived here."""
        arrived = self._comm.alltoall(self._by_place(keys, list(data))[0])
        return tuple(np.concatenate(column) for column in zip(*arrived, strict=True))

    def position(self, keys: Keys) -> Keys:
        """Return where keys stand in ``self.keys``; -1 for those that nobody holds."""
        if self.keys.size == 0:
            return np.full(keys.shape, -1, dtype=np.int64)
        at = np.minimum(np.searchsorted(self.keys, keys), self.keys.size - 1)
        return np.where(self.keys[at] == keys, at, -1).astype(np.int64)

    def lookup(self, keys: Keys, *tables: Array) -> tuple[Array, ...]:
        """Return the rows of distributed tables for any keys.

        Parameters
        ----------
        keys : (k,) integer array
            What this rank asks for.
        *tables : (d, ...) arrays
            The tables' rows for ``self.keys``.

        Returns
        -------
        found, rows... : (k,) bool array, (k, ...) arrays
            Whether somebody holds the key, and its row of each table (zeros if nobody does).
        """
        questions, order = self._by_place(keys, [])
        answers = []
        for (asked,) in self._comm.alltoall(questions):
            at = self.position(asked)
            rows = [table[at] if table.size else table[:0] for table in tables]
            rows = [
                self._blank_missing(row, at, table) for row, table in zip(rows, tables, strict=True)
            ]
            answers.append((at >= 0, *rows))
        columns = zip(*self._comm.alltoall(answers), strict=True)
        inverse = np.argsort(order, kind="stable")
        return tuple(np.concatenate(column)[inverse] for column in columns)

    @staticmethod
    def _blank_missing(rows: Array, at: Keys, table: Array) -> Array:
        if rows.shape[0] != at.size:
            return np.zeros((at.size, *table.shape[1:]), dtype=table.dtype)
        rows[at < 0] = 0
        return rows

    def forward(self, keys: Keys, *data: Array) -> tuple[Array, ...]:
        """Send rows (key, data...) to all holders of the keys; return the columns for this rank.

        The rows of a key arrive in the order of the ranks that sent them.
        """
        columns = self.collect(keys, *data)
        first = np.searchsorted(self._held, columns[0], side="left")
        number = np.searchsorted(self._held, columns[0], side="right") - first
        row = np.repeat(np.arange(columns[0].size), number)
        holder = self._holders[
            np.repeat(first - np.cumsum(number) + number, number) + np.arange(row.size)
        ]
        order = np.argsort(holder, kind="stable")
        cuts = np.searchsorted(holder[order], np.arange(1, self._comm.size))
        split = [np.split(column[row[order]], cuts) for column in columns]
        arrived = self._comm.alltoall(list(zip(*split, strict=True)))
        return tuple(np.concatenate(column) for column in zip(*arrived, strict=True))
