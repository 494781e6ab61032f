"""Communication between ranks: collective errors, gathered arrays, the directory of numbers.

All of it is for the set-up. The communication of the iterations is in
`fenics_tfeti.feti.constraints.dual_layout`.
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO, TypeVar

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.errors import InputError, first_few, warn_user
from fenics_tfeti.typing import Array, Numbers, Vector

T = TypeVar("T")

# seconds until ranks say that they wait for others, and the tag of messages that tell them
_PATIENCE, _TAG = 30.0, 24681


@contextmanager
def raise_collectively(comm: MPI.Comm) -> Iterator[None]:
    """Make an error in a block *without communication* an error on all ranks.

    Collective: the ranks leave the block together, so none waits for one that has raised. All raise
    the error of the lowest rank that has one, which keeps its traceback there. An error that cannot
    be pickled is a RuntimeError with its name and message on the other ranks.

    >>> with raise_collectively(MPI.COMM_WORLD):
    ...     if MPI.COMM_WORLD.rank == 0:
    ...         raise ValueError("bad input")
    Traceback (most recent call last):
    ValueError: bad input
    """
    local: Exception | None = None
    try:
        yield
    except Exception as caught:
        local = caught
    for rank, error in enumerate(comm.allgather(_portable(local))):
        if error is not None:
            raise local if local is not None and rank == comm.rank else error


def _portable(error: Exception | None) -> Exception | None:
    """Return the error, or a RuntimeError in place of one that cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def meet(comm: MPI.Comm, call: str, patience: float | None = None) -> None:
    """Wait until all ranks are in a call, and tell who is not. Collective.

    A function that all ranks have to call waits for ever where some do not. After `patience`
    seconds, by default those of the environment variable FENICS_TFETI_PATIENCE or 30, the ranks
    that wait say so on standard error; after ten times as long they raise `InputError`. Their
    messages to the others then stay in the communicator, which is of no use any more and must not
    be freed.
    """
    if comm.size == 1:
        return
    if patience is None:
        patience = float(os.environ.get("FENICS_TFETI_PATIENCE", _PATIENCE))
    others = [rank for rank in range(comm.size) if rank != comm.rank]
    received = {rank: comm.Irecv([None, MPI.BYTE], rank, _TAG) for rank in others}
    sent = [comm.Isend([None, MPI.BYTE], rank, _TAG) for rank in others]
    message = ""
    for wait in (patience, 9.0 * patience):
        if _all_complete(list(received.values()), wait):
            MPI.Request.Waitall(sent)
            return
        missing = {rank: request for rank, request in received.items() if not request.Test()}
        is_first, message = not message, _not_in(list(missing), call)
        if is_first and missing:
            print(message, file=sys.stderr, flush=True)
    for request in missing.values():
        request.Cancel()
        request.Wait()
    raise InputError(message)


def _all_complete(requests: list[MPI.Request], seconds: float) -> bool:
    """Tell whether all requests complete within some seconds."""
    end, pause = time.monotonic() + seconds, 1e-5
    while not MPI.Request.Testall(requests):
        if time.monotonic() > end:
            return False
        time.sleep(pause)
        pause = min(2.0 * pause, 1e-2)
    return True


def _not_in(ranks: list[int], call: str) -> str:
    names = first_few([str(rank) for rank in ranks], 4, "ranks")
    who = f"rank {names[0]} is" if len(ranks) == 1 else f"ranks {', '.join(names)} are"
    return f"{who} not in {call}: call it on all ranks"


def print_on_first_rank(comm: MPI.Comm, text: str, file: TextIO | None = None) -> None:
    """Print a text on rank 0, at once."""
    if comm.rank == 0:
        print(text, file=file, flush=True)


def warn_on_first_rank(comm: MPI.Comm, *messages: str) -> None:
    """Warn the user on rank 0; what a filter makes an error is one on all ranks. Collective."""
    with raise_collectively(comm):
        for message in messages if comm.rank == 0 else ():
            warn_user(message)


def concatenate_ranks(comm: MPI.Intracomm, part: Array) -> Array:
    """Return the arrays of all ranks, concatenated in the order of ranks, on all ranks."""
    if comm.size == 1:
        return np.concatenate([part])
    return np.concatenate(comm.allgather(part))


def concatenate_buffers(comm: MPI.Intracomm, *parts: Array) -> list[Array]:
    """Concatenate vectors of equal length and numeric type as `concatenate_ranks`, unpickled."""
    if comm.size == 1:
        return [part.copy() for part in parts]
    rows: Array = np.rec.fromarrays(parts)
    counts = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([rows.size]), counts)
    whole = np.empty(int(counts.sum()), dtype=rows.dtype)
    kind = MPI.BYTE.Create_contiguous(rows.itemsize).Commit()
    sent, received = (x.view(np.uint8) for x in (rows, whole))
    comm.Allgatherv([sent, rows.size, kind], [received, counts.tolist(), kind])
    kind.Free()
    return [np.ascontiguousarray(whole[name]) for name in rows.dtype.names or ()]


def first_of_rank(comm: MPI.Intracomm, count: int) -> tuple[int, int]:
    """Return the sums of the counts of lower ranks and of all ranks."""
    counts = comm.allgather(count)
    return sum(counts[: comm.rank]), sum(counts)


def any_rank(comm: MPI.Intracomm, mask: Any) -> bool:
    """Tell, with one answer on all ranks, whether an entry of a mask is true on any. Collective."""
    return bool(comm.allreduce(bool(np.any(mask)), MPI.LOR))


def largest_of_ranks(comm: MPI.Intracomm, values: ArrayLike) -> float:
    """Return the largest of numbers of all ranks, 0 if there is none above. Collective."""
    largest = np.array([np.max(values, initial=0.0)])
    comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    return float(largest[0])


def count_over_ranks(comm: MPI.Intracomm, numbers: Numbers) -> int:
    """Return how many things there are whose numbers 0, 1, ... the ranks have. Collective."""
    return int(comm.allreduce(int(numbers.max(initial=-1)), MPI.MAX)) + 1


def all_to_all(comm: MPI.Intracomm, messages: Sequence[T]) -> list[T]:
    """Send a message to each rank, uncopied to itself; return those that arrive, by rank."""
    if comm.size == 1:
        return list(messages)
    to_others = [None if rank == comm.rank else m for rank, m in enumerate(messages)]
    received = comm.alltoall(to_others)
    return [messages[rank] if rank == comm.rank else m for rank, m in enumerate(received)]


def send_rows(comm: MPI.Intracomm, ranks: Array, *columns: Array) -> tuple[Array, ...]:
    """Send each row to a rank; return the columns that arrive. Collective.

    Rows arrive in the order of the ranks that sent them, those of a rank in the order given.
    """
    if comm.size == 1:
        return columns
    received = all_to_all(comm, _by_rank(comm, ranks, columns)[0])
    return tuple(np.concatenate(column) for column in zip(*received, strict=True))


def _by_rank(
    comm: MPI.Intracomm, ranks: Array, columns: Sequence[Array]
) -> tuple[list[tuple[Array, ...]], NDArray[np.intp]]:
    """Split columns by the ranks to which their rows go; also return the order used."""
    order = np.argsort(ranks, kind="stable")
    cuts = np.searchsorted(ranks[order], np.arange(1, comm.size))
    parts = [np.split(column[order], cuts) for column in columns]
    return list(zip(*parts, strict=True)), order


class Directory:
    """A distributed directory of integer keys, such as global node numbers.

    Any rank may hold a key; each gives its distinct ones. Each key has a home rank, by its number,
    which knows the ranks that hold it and keeps its row of distributed tables. ``keys`` are those
    whose home is this rank, ascending.
    """

    def __init__(self, comm: MPI.Intracomm, keys: Numbers) -> None:
        self._comm = comm
        limit = count_over_ranks(comm, keys)
        self._chunk = max(1, -(-limit // comm.size))
        received = all_to_all(comm, _by_rank(comm, self._home(keys), [keys])[0])
        ranks = np.repeat(np.arange(comm.size), [rows[0].size for rows in received])
        keys_held = np.concatenate([rows[0] for rows in received])
        order = np.argsort(keys_held, kind="stable")
        self._held, self._holders = keys_held[order], ranks[order]
        self.keys: Numbers = np.unique(keys_held)

    def _home(self, keys: Numbers) -> Array:
        # keys that no rank holds may lie beyond the limit
        return np.clip(keys // self._chunk, 0, self._comm.size - 1)

    def collect(self, keys: Numbers, *data: Array) -> tuple[Array, ...]:
        """Send rows (key, data...) to the keys' homes; return columns as `send_rows` does."""
        return send_rows(self._comm, self._home(keys), keys, *data)

    def table(self, keys: Numbers, *data: Array) -> tuple[Array, ...]:
        """Return tables for ``self.keys`` of rows (key, data...); one row of each key counts.

        Rows of keys that no rank holds are left out.
        """
        keys, *columns = self.collect(keys, *data)
        home = self.position(keys)
        known = home >= 0
        tables = []
        for column in columns:
            table = np.zeros((self.keys.size, *column.shape[1:]), dtype=column.dtype)
            table[home[known]] = column[known]
            tables.append(table)
        return tuple(tables)

    def sums(self, keys: Numbers, values: Vector) -> Vector:
        """Return the sums of values (k,) or (k, n) of each of ``self.keys``, as `table`."""
        keys, values = self.collect(keys, values)
        home = self.position(keys)
        known, size = home >= 0, self.keys.size
        columns = np.atleast_2d(values.T)[:, known]
        sums = [np.bincount(home[known], column, size).astype(np.float64) for column in columns]
        return sums[0] if values.ndim == 1 else np.column_stack(sums)

    def position(self, keys: Numbers) -> Numbers:
        """Return the positions of keys in ``self.keys``; -1 for keys that no rank holds."""
        return positions(self.keys, keys)

    def lookup(self, keys: Numbers, *tables: Array) -> tuple[Array, ...]:
        """Return for keys (k,) whether a rank holds them, and their rows of distributed tables.

        Tables have a row for each of ``self.keys``; rows of keys that no rank holds are zero.
        """
        questions, order = _by_rank(self._comm, self._home(keys), [keys])
        answers = []
        for (query,) in all_to_all(self._comm, questions):
            position = self.position(query)
            answers.append((position >= 0, *(_rows(table, position) for table in tables)))
        columns = zip(*all_to_all(self._comm, answers), strict=True)
        inverse = np.argsort(order, kind="stable")
        return tuple(np.concatenate(column)[inverse] for column in columns)

    def forward(self, keys: Numbers, *data: Array) -> tuple[Array, ...]:
        """Send rows (key, data...) to all ranks that hold the keys; return columns by sender."""
        columns = self.collect(keys, *data)
        first = np.searchsorted(self._held, columns[0], side="left")
        number = np.searchsorted(self._held, columns[0], side="right") - first
        row = np.repeat(np.arange(columns[0].size), number)
        holder = self._holders[
            np.repeat(first - np.cumsum(number) + number, number) + np.arange(row.size)
        ]
        return send_rows(self._comm, holder, *(column[row] for column in columns))


def positions(ascending: Numbers, values: Numbers) -> Numbers:
    """Return the positions of values among ascending numbers, -1 for others."""
    if ascending.size == 0:
        return np.full(values.shape, -1, dtype=np.int64)
    position = np.minimum(np.searchsorted(ascending, values), ascending.size - 1)
    return np.where(ascending[position] == values, position, -1).astype(np.int64)


def _rows(table: Array, position: Numbers) -> Array:
    """Return rows of a table, zero where the position is negative."""
    rows = np.zeros((position.size, *table.shape[1:]), dtype=table.dtype)
    rows[position >= 0] = table[position[position >= 0]]
    return rows


def largest_of_groups(
    comm: MPI.Intracomm, values: Vector, contact: Numbers, contacts: int, initial: float
) -> Vector:
    """Return the largest of the values (k, ...) of each contact, over all ranks. Collective."""
    largest = np.full((contacts, *values.shape[1:]), initial)
    np.maximum.at(largest, contact, values)
    comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    return largest
