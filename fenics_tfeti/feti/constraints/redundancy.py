"""Contact conditions that repeat, exclude or depend on others (corners, edges, several contacts).

Each condition of a node that is in several contacts is a row of its own. The rows that remain need
not be orthogonal to each other: their Gram matrix W is the part of B D^{-1} B' = blockdiag(I, W)
that differs from the identity. A contact row that a parallel row with the same or a smaller gap
implies is dropped: with it the multipliers would not be unique. So is a row that a tied row
decides, parallel or opposite to it. Tangential rows of friction imply nothing and are implied by
nothing: their forces are limited.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.local.fixing_nodes import unknowns_of_nodes
from fenics_tfeti.feti.tolerances import PARALLEL
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class ContactConditions:
    """The conditions of this rank, in coordinates where B D^{-1} B' is a dot product.

    The coefficients of a row have length 1 together, those of a tangential row 1 at most.
    """

    row: Numbers  # (t,): row of this rank of each term; rows without a term are not examined
    node: Numbers  # (t,): global node number of the term
    coefficients: Vector  # (t, gdim): row of B times D^{-1/2} at the node
    rhs: Vector  # (k,): right-hand sides of this rank's rows, in the same scale
    tolerance: Vector  # (k,): their rounding
    tied: Mask  # (k,): equalities
    tangential: Mask  # (k,): tangential rows of friction


@dataclass(frozen=True)
class Redundancy:
    """Rows that others imply, and rows that are not orthogonal to all others."""

    # (k,): rows of this rank that a parallel row with no larger gap implies, or a tied one
    dropped: Mask
    dropped_total: int  # their number over all ranks
    coupled: Mask  # (k,): rows of this rank, none dropped, that are not orthogonal to all others
    # (w, w): B D^{-1} B' of the coupled rows of all ranks, rank by rank; the same on all ranks
    gram: sp.csr_matrix


def find_redundant(
    conditions: ContactConditions, directory: Directory, comm: MPI.Intracomm
) -> Redundancy:
    """Find rows that other rows imply, and those that are not orthogonal to all others.

    Rows that share a node are gathered on all ranks. Of node to node contact their number grows
    with the edges between contact surfaces; of mortars they are all rows. Raises an InputError on
    all ranks if two opposite conditions exclude each other, or a tied row contradicts a parallel
    one.
    """
    first = first_of_rank(comm, conditions.rhs.size)[0]
    number = first + np.arange(conditions.rhs.size, dtype=np.int64)
    row = first + conditions.row
    several = _in_several_rows(directory, conditions.node)
    chosen = np.isin(number, row[several])
    rows = _Rows(
        *(
            concatenate_ranks(comm, column[chosen])
            for column in (
                number,
                conditions.rhs,
                conditions.tolerance,
                conditions.tied,
                conditions.tangential,
            )
        )
    )
    taken = np.isin(row, number[chosen])
    node, row, coefficients = (
        concatenate_ranks(comm, column[taken])
        for column in (conditions.node, row, conditions.coefficients)
    )
    dropped, coupled, gram = _examine(rows, node, row, coefficients)
    return Redundancy(np.isin(number, dropped), dropped.size, np.isin(number, coupled), gram)


@dataclass(frozen=True)
class _Rows:
    """Rows of all ranks that share a node with others, by ascending number."""

    number: Numbers
    rhs: Vector
    tolerance: Vector
    tied: Mask
    tangential: Mask


def _in_several_rows(directory: Directory, node: Numbers) -> Mask:
    """Return which terms are at nodes that several rows, of any rank, act on."""
    count = directory.sums(node, np.ones(node.size))
    return directory.lookup(node, count)[1] > 1


def _examine(
    rows: _Rows, node: Numbers, row: Numbers, coefficients: Vector
) -> tuple[Numbers, Numbers, sp.csr_matrix]:
    """Return the numbers of the rows to drop, those of the coupled rows, and their Gram matrix."""
    if rows.number.size == 0:
        return rows.number, rows.number, sp.csr_matrix((0, 0))
    gdim = coefficients.shape[1]
    column = np.unique(node, return_inverse=True)[1].ravel()
    position = np.repeat(np.searchsorted(rows.number, row), gdim)
    columns = unknowns_of_nodes(column, gdim)
    C = sp.csr_matrix(
        (coefficients.ravel(), (position, columns)), (rows.number.size, int(columns.max()) + 1)
    )
    gram = (C @ C.T).tocoo()
    limited = (rows.tangential[gram.row] | rows.tangential[gram.col]) & (gram.row != gram.col)
    implying = sp.coo_matrix((np.where(limited, 0.0, gram.data), (gram.row, gram.col)), gram.shape)
    _check_pairs(rows, implying, node, row)

    # a tied row decides those that are opposite to it, too
    decided = rows.tied[gram.row] | rows.tied[gram.col]
    parallel = np.where(decided, np.abs(implying.data), implying.data) > 1.0 - PARALLEL
    graph = sp.coo_matrix(
        (gram.data[parallel], (gram.row[parallel], gram.col[parallel])), gram.shape
    )
    group = connected_components(graph, directed=False)[1]
    # a tied row of each group stays, or the smallest right-hand side, the first of equal ones
    order = np.lexsort((rows.number, rows.rhs, ~rows.tied, group))
    stays = np.sort(order[np.unique(group[order], return_index=True)[1]])
    dropped = np.delete(rows.number, stays)

    gram = gram.tocsr()[stays][:, stays]
    gram.eliminate_zeros()
    # a tangential row may be shorter than the other one of its site
    shorter = np.abs(gram.diagonal() - 1.0) > PARALLEL
    coupled = np.flatnonzero((np.diff(gram.indptr) > 1) | shorter)
    return dropped, rows.number[stays[coupled]], gram[coupled][:, coupled]


def _check_pairs(rows: _Rows, gram: sp.coo_matrix, node: Numbers, row: Numbers) -> None:
    """Check that opposite contact rows leave room, and that tied rows agree with parallel ones.

    Condition i, or its opposite, implies condition j where s rhs_i <= rhs_j, s = 1 or -1. The data
    are the same on all ranks.
    """
    parallel = np.abs(gram.data) > 1.0 - PARALLEL
    i, j, sign = gram.row[parallel], gram.col[parallel], np.sign(gram.data[parallel])
    excess = sign * rows.rhs[i] - rows.rhs[j]
    violated = np.where(rows.tied[i] & rows.tied[j], np.abs(excess), excess)
    wrong = violated > rows.tolerance[i] + rows.tolerance[j]
    excluded = i[wrong & (sign < 0.0) & ~(rows.tied[i] | rows.tied[j])]
    if excluded.size:
        nodes = node[row == rows.number[excluded[0]]].tolist()
        raise InputError(
            f"{excluded.size // 2} pairs of contact conditions exclude each other: they press on "
            f"the same nodes from opposite sides and leave no room, the first at the nodes {nodes} "
            f"(global numbers). Make more room between the contacts, or remove one of them"
        )
    contradicted = i[wrong & rows.tied[i]]
    if contradicted.size:
        nodes = node[row == rows.number[contradicted[0]]].tolist()
        raise InputError(
            f"{np.unique(contradicted).size} tied conditions contradict other conditions of the "
            f"same nodes, the first at the nodes {nodes} (global numbers). Tie each surface once, "
            "and take tied nodes out of contacts that leave them no room"
        )
