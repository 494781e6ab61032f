"""Groups of sparse columns that share no rows, and what dense algebra does for each of them.

Many loose bodies have many free motions, each of one or a few bodies: a basis of them is sparse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from fenics_tfeti.feti.tolerances import rounding
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class ColumnGroups:
    """Groups of columns that share no rows with other groups; of one shape."""

    rows: Numbers  # (g, n)
    columns: Numbers  # (g, k)
    dense: Vector  # (g, n, k): entries


def column_groups(columns: sp.csr_matrix) -> list[ColumnGroups]:
    """Split columns into groups that share no rows.

    The columns (n, k) are not empty; entries that are stored count, also zero ones.
    """
    if not columns.shape[1]:
        return []
    coo = columns.tocoo()
    rows, row = np.unique(coo.row, return_inverse=True)
    # a graph of rows and columns: products of sparse columns may be dense
    size = rows.size + columns.shape[1]
    edges = (np.ones(row.size, dtype=np.int8), (row.ravel(), rows.size + coo.col))
    group = connected_components(sp.coo_matrix(edges, (size, size)), directed=False)[1]
    of_column = group[rows.size :]
    row_order, row_place, heights = sorted_by(group[: rows.size])
    column_order, column_place, widths = sorted_by(of_column)
    group, row = of_column[coo.col], row_place[row.ravel()]
    found = []
    for height, width in np.unique(np.stack([heights, widths], axis=1), axis=0):
        chosen = np.flatnonzero((heights == height) & (widths == width))
        slot = np.full(heights.size, -1)
        slot[chosen] = np.arange(chosen.size)
        entry = slot[group] >= 0
        dense = np.zeros((chosen.size, height, width))
        dense[slot[group[entry]], row[entry], column_place[coo.col[entry]]] = coo.data[entry]
        of_rows = rows[row_order][(np.cumsum(heights) - heights)[chosen, None] + np.arange(height)]
        of_columns = column_order[(np.cumsum(widths) - widths)[chosen, None] + np.arange(width)]
        found.append(ColumnGroups(of_rows.astype(np.int64), of_columns, dense))
    return found


def sorted_by(group: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Return items by groups, the place of each item in its group, and the groups' sizes."""
    order, sizes = np.argsort(group, kind="stable"), np.bincount(group)
    place = np.empty(group.size, dtype=np.int64)
    place[order] = np.arange(group.size) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return order, place, sizes


def of_one_body(motions: sp.csc_matrix, modes: int) -> NDArray[np.bool_]:
    """Tell which motions (modes * bodies, k > 0), none of them empty, move one body only."""
    body, starts = motions.indices // modes, motions.indptr[:-1]
    return np.minimum.reduceat(body, starts) == np.maximum.reduceat(body, starts)


def orthonormal_columns(columns: sp.csr_matrix, others: sp.csr_matrix) -> sp.csr_matrix:
    """Return an orthonormal basis of the range of independent columns.

    There are many columns (n, k) in small groups, and few others (n, l), which may share rows with
    all of them. The first k of the result are as sparse as the groups allow.
    """
    data, row, column = [np.zeros(0)], [np.zeros(0, dtype=int)], [np.zeros(0, dtype=int)]
    for groups in column_groups(columns):
        Q = np.linalg.qr(groups.dense)[0]
        data.append(Q.ravel())
        row.append(np.broadcast_to(groups.rows[:, :, None], Q.shape).ravel())
        column.append(np.broadcast_to(groups.columns[:, None, :], Q.shape).ravel())
    where = (np.concatenate(row), np.concatenate(column))
    first = sp.csr_matrix((np.concatenate(data), where), shape=columns.shape)
    rest = others.toarray()
    # twice: what rounding leaves of a projection that takes most of a column away
    for _ in range(2):
        rest = np.linalg.qr(rest - first @ (first.T @ rest))[0]
    # where a group has no part in the others, rounding leaves none
    rest[np.abs(rest) <= rounding(1.0)] = 0.0
    return sp.hstack([first, sp.csr_matrix(rest)], format="csr")


def pivot_rows(columns: sp.csr_matrix, others: sp.csr_matrix) -> Numbers:
    """Return as many rows as there are columns, which are independent there.

    There are many independent columns (n, k) in small groups, and few others (n, l), which may
    share rows with all of them.
    """
    found = [np.zeros(0, dtype=np.int64)]
    for groups in column_groups(columns):
        rest = groups.dense.copy()
        every = np.arange(len(rest))
        # QR with pivoting of the transposes: the row that is farthest from those chosen comes next
        for _ in range(rest.shape[2]):
            lengths = np.linalg.norm(rest, axis=2)
            pivot = np.argmax(lengths, axis=1)
            found.append(groups.rows[every, pivot])
            along = rest[every, pivot] / lengths[every, pivot, None]
            rest -= (rest @ along[:, :, None]) * along[:, None, :]
    first = np.concatenate(found)
    if not others.shape[1]:
        return first
    rest = others.toarray()
    if first.size:
        # combinations that vanish in the rows chosen
        rest -= columns @ splu(columns[first].tocsc()).solve(rest[first])
        rest[first] = 0.0
    pivots = qr(rest.T, mode="r", pivoting=True)[1][: others.shape[1]]
    return np.concatenate([first, pivots.astype(np.int64)])
