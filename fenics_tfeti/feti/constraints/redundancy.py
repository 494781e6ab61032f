"""Conditions that repeat, decide, exclude or depend on others (corners, edges, several contacts).

Conditions are compared with all their terms; those at rigid bodies count as what they do to the
motions of the body. Equal conditions have one row of B and share its force by their areas: contact
rows with the same normal and gap, tied rows of surfaces that are tied twice, tangential rows with
the same slip whose contact rows are one. Rows with springs always have their own. Of parallel
contact rows with other gaps those with the smallest one alone can touch. A condition that is a sum
of tied rows is decided by them and has no row. A contact row without a row has no force that
friction could be a part of.

The rows that remain need not be orthogonal to each other: their Gram matrix W is the part of
B D^{-1} B' = blockdiag(I, W) that differs from the identity.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.tolerances import PARALLEL
from fenics_tfeti.parallel import Directory, concatenate_ranks, positions
from fenics_tfeti.typing import Array, Mask, Numbers, Vector


@dataclass(frozen=True)
class Terms:
    """Entries of conditions whose slave's sums have length 1.

    Columns are components of nodes, gdim * node + component, and motions of rigid bodies, numbered
    -1, -2, ... Rigid bodies do not give way: their flexibility is zero.
    """

    row: Numbers  # (t,): numbers of the conditions
    column: Numbers  # (t,)
    value: Vector  # (t,)
    flexibility: Vector  # (t,): entry of D^{-1}

    def chosen(self, terms: Mask) -> Terms:
        """Return some of the entries."""
        return Terms(*(column[terms] for column in vars(self).values()))


@dataclass(frozen=True)
class Conditions:
    """Conditions by ascending number; those without terms are not compared."""

    number: Numbers  # (k,): global numbers
    scale: Vector  # (k,): makes B D^{-1} B' = 1, or less for one of the tangential rows of a site
    rhs: Vector  # (k,): right-hand sides, scaled
    tolerance: Vector  # (k,): their rounding
    tied: Mask  # (k,): equalities
    area: Vector  # (k,): of the slave's surface
    site: Numbers  # (k,): site of friction of tangential rows; -1 of others
    direction: Numbers  # (k,): number of the tangent
    normal: Numbers  # (k,): number of the contact row of tangential rows; -1 of others
    bounded: Mask  # (k,): tangential rows with a slip bound that needs no normal force
    spring: Mask  # (k,): contact rows with a spring or adhesion, tangential ones with elastic slip
    soft: Mask  # (k,): contact rows that give way where they press

    def chosen(self, rows: Mask) -> Conditions:
        """Return some of the conditions."""
        return Conditions(*(column[rows] for column in vars(self).values()))


@dataclass(frozen=True)
class Redundancy:
    """The rows of B that this rank's conditions have, and which are not orthogonal to all."""

    shared: Mask  # (k,): conditions that share a node with others
    own: Mask  # (k,): conditions with a row of their own
    # (s,): the condition whose row each shared one has, by its position among those of all ranks;
    # -1 without a row
    row: Numbers
    share: Vector  # (k,): part of the row's force, negative for a condition opposite to the row
    closed: Mask  # (k,): conditions that tied rows hold with equality
    dropped: int  # contact and tied rows without a row of their own, over all ranks
    coupled: Mask  # (k,): rows of this rank that are not orthogonal to all others
    # of the coupled rows of all ranks, rank by rank; the same on all ranks
    gram: sp.csr_matrix  # (w, w): B D^{-1} B'
    rigid: sp.csr_matrix  # (w, q): what they do to motions of rigid bodies

    @property
    def has_row(self) -> Mask:
        """Which conditions have a row, of their own or another one's."""
        mask = self.own.copy()
        mask[self.shared] = self.row >= 0
        return mask

    def of_rows(self, comm: MPI.Intracomm, column: Array) -> Array:
        """Return the data (k,) of the rows that conditions have, by those given. Collective."""
        of_all, of_rows = concatenate_ranks(comm, column[self.shared]), column.copy()
        of_rows[self.shared & self.has_row] = of_all[self.row[self.row >= 0]]
        return of_rows


def find_redundant(
    conditions: Conditions, terms: Terms, gdim: int, directory: Directory, comm: MPI.Intracomm
) -> Redundancy:
    """Find conditions that have the row of another one, or none, and rows that are not orthogonal.

    Conditions that share a node are gathered on all ranks. Of node to node contact their number
    grows with the edges between contact surfaces; of mortars they are all rows. Raises an
    InputError on all ranks if two opposite conditions exclude each other, or if tied rows
    contradict each other or a contact.
    """
    number = conditions.number
    shared = np.isin(number, terms.row[_in_several_conditions(directory, terms, gdim)])
    terms = terms.chosen(np.isin(terms.row, number[shared]))
    rows = Conditions(*_gathered(conditions.chosen(shared), comm))
    compared = _Compared.build(rows, Terms(*_gathered(terms, comm)), gdim)
    row, share = compared.rows()
    own = row == np.arange(row.size)
    coupled, gram, rigid = compared.coupled(own)
    here = np.isin(rows.number, number)

    def spread(of_all: Array, default: Array) -> Array:
        column = default.copy()
        column[shared] = of_all[here]
        return column

    no, one = np.zeros(number.size, dtype=bool), np.ones(number.size)
    return Redundancy(
        shared,
        spread(own, ~no),
        row[here],
        spread(share, one),
        spread(compared.closed, no),
        int(np.count_nonzero(~own & (rows.site < 0))),
        spread(coupled, no),
        gram,
        rigid,
    )


def _gathered(part: Conditions | Terms, comm: MPI.Intracomm) -> list[Array]:
    """Return the columns of all ranks. Collective."""
    return [concatenate_ranks(comm, column) for column in vars(part).values()]


def _in_several_conditions(directory: Directory, terms: Terms, gdim: int) -> Mask:
    """Return which terms are at nodes that several conditions, of any rank, act on."""
    at_nodes = np.flatnonzero(terms.flexibility > 0.0)
    row, node = terms.row[at_nodes], terms.column[at_nodes] // gdim
    distinct = np.unique(np.stack([row, node]), axis=1)[1]
    count = directory.sums(distinct, np.ones(distinct.size))
    several = np.zeros(terms.row.size, dtype=bool)
    several[at_nodes] = directory.lookup(node, count)[1] > 1
    return several


@dataclass(frozen=True)
class _Compared:
    """The conditions of all ranks that share nodes, checked against each other."""

    conditions: Conditions
    matrix: sp.csr_matrix  # (k, n): all terms, scaled as rows of B
    gram: sp.csr_matrix  # (k, k): B D^{-1} B'
    is_motion: Mask  # (n,): columns that are motions of rigid bodies
    decided: Mask  # (k,): sums of tied rows
    closed: Mask  # (k,): of which the tied rows leave nothing of the right-hand side
    # pairs (p,) of conditions with parallel terms, and the signs of their products
    i: Numbers
    j: Numbers
    sign: Vector

    @staticmethod
    def build(rows: Conditions, terms: Terms, gdim: int) -> _Compared:
        """Compare conditions; `InputError` if tied ones or opposite ones contradict others."""
        columns, column = np.unique(terms.column, return_inverse=True)
        row = np.searchsorted(rows.number, terms.row)
        places, shape = np.stack([row, column.ravel()]), (rows.number.size, columns.size)
        values, soft = rows.scale[row] * terms.value, terms.flexibility > 0.0
        matrix = sp.csr_matrix((values, places), shape)
        weighted = values[soft] * np.sqrt(terms.flexibility[soft])
        C = sp.csr_matrix((weighted, places[:, soft]), shape)
        gram = (C @ C.T).tocsr()
        decided, left, tolerance = _decided_by_ties(rows, matrix, gram)
        i, j, sign = _parallel_pairs(matrix, gram)
        contradicted = decided & (rows.site < 0) & ~rows.soft & (left < -tolerance)
        _check_room(rows, i, j, sign, contradicted, matrix, columns // gdim)
        closed = decided & (np.abs(left) <= tolerance)
        return _Compared(rows, matrix, gram, columns < 0, decided, closed, i, j, sign)

    def rows(self) -> tuple[Numbers, Vector]:
        """Return the condition whose row each one has, or -1, and its share of the row's force."""
        rows, friction = self.conditions, self.conditions.site >= 0
        alike = np.where(rows.tied[self.i], rows.tied[self.j], ~rows.tied[self.j] & (self.sign > 0))
        # springs side by side have rows of their own
        alone = self.decided | friction | rows.spring
        alike &= ~alone[self.i] & ~alone[self.j]
        group = _components(self.i[alike], self.j[alike], rows.number.size)
        # the first tied row, or the first of the contact rows with the smallest gap
        row = _first_of_groups(group, rows.number, np.where(rows.tied, 0.0, rows.rhs))
        room = rows.rhs - rows.rhs[row]
        far = ~rows.tied & (room > rows.tolerance + rows.tolerance[row])
        row[~friction & (self.decided | far)] = -1
        row[friction] = self._rows_of_friction(row)[friction]
        return row, self._shares(row)

    def _rows_of_friction(self, row: Numbers) -> Numbers:
        """Return the rows that tangential conditions have, by those of contact rows."""
        rows, own = self.conditions, np.arange(row.size)
        normal = positions(rows.number, rows.normal)
        contact = np.where(normal < 0, -1, row[normal])
        is_open = (normal >= 0) & (contact < 0) & ~self.closed[normal]
        # tied rows may prescribe a slip, which friction resists
        active = (rows.site >= 0) & ~self.closed & (rows.bounded | ~is_open)
        i, j = self.i, self.j
        same = active[i] & active[j] & (contact[i] >= 0) & (contact[i] == contact[j])
        same &= (self.sign > 0.0) & (rows.direction[i] == rows.direction[j])
        same &= ~rows.spring[i] & ~rows.spring[j]
        same &= np.abs(rows.rhs[i] - rows.rhs[j]) <= rows.tolerance[i] + rows.tolerance[j]
        same &= np.abs(rows.scale[i] - rows.scale[j]) <= PARALLEL * rows.scale[i]
        # sites are one if all of their rows are
        sites, site = np.unique(rows.site, return_inverse=True)
        number = np.bincount(site.ravel()[active], minlength=sites.size)
        pairs, agree = np.unique(
            np.stack([site.ravel()[i], site.ravel()[j]])[:, same], axis=1, return_counts=True
        )
        pairs = pairs[:, (agree == number[pairs]).all(axis=0)]
        group = _components(pairs[0], pairs[1], sites.size)[site.ravel()]
        of_rows = group * (1 + rows.direction.max(initial=0)) + rows.direction
        first = _first_of_groups(np.where(active, of_rows, -1 - own), rows.number)
        return np.where(active, first, -1)

    def _shares(self, row: Numbers) -> Vector:
        """Return the signed shares (k,) of conditions of the forces of their rows, by area."""
        has_row = row >= 0
        area, number = (
            np.bincount(row[has_row], weights, row.size)[row]
            for weights in (self.conditions.area[has_row], None)
        )
        share = np.divide(
            self.conditions.area, area, out=1.0 / np.maximum(number, 1), where=area > 0.0
        )
        products = self.matrix[has_row].multiply(self.matrix[row[has_row]]).sum(axis=1)
        share[has_row] *= np.sign(np.asarray(products).ravel())
        return share

    def coupled(self, own: Mask) -> tuple[Mask, sp.csr_matrix, sp.csr_matrix]:
        """Return which rows are not orthogonal to all others, W, and their terms at rigid bodies.

        `own` (k,) are the conditions with rows of their own.
        """
        stays = np.flatnonzero(own)
        gram = self.gram[stays][:, stays]
        gram.eliminate_zeros()
        # a tangential row may be shorter than the other one of its site
        shorter = np.abs(gram.diagonal() - 1.0) > PARALLEL
        rows = np.flatnonzero((np.diff(gram.indptr) > 1) | shorter)
        mask = np.zeros(own.size, dtype=bool)
        mask[stays[rows]] = True
        return mask, gram[rows][:, rows], self.matrix[mask][:, self.is_motion]


def _decided_by_ties(
    rows: Conditions, matrix: sp.csr_matrix, gram: sp.csr_matrix
) -> tuple[Mask, Vector, Vector]:
    """Return the conditions (k,) that are sums of tied rows, what these leave, and its rounding."""
    decided, left, tolerance = (
        np.zeros(rows.tied.size, bool),
        rows.rhs.copy(),
        rows.tolerance.copy(),
    )
    tied = np.flatnonzero(rows.tied)
    untied = np.asarray(abs(matrix[tied]).sum(axis=0)).ravel() == 0.0
    covered = (abs(matrix) @ untied.astype(float) == 0.0) & ~rows.tied
    for k in np.flatnonzero(covered):
        near = np.intersect1d(gram[k].indices, tied)
        W, right = gram[near][:, near].toarray(), gram[near][:, k].toarray().ravel()
        factors = np.linalg.lstsq(W, right, rcond=PARALLEL)[0]
        rest = matrix[k] - sp.csr_matrix(factors) @ matrix[near]
        if rest.power(2).sum() <= 2.0 * PARALLEL * matrix[k].power(2).sum():
            decided[k] = True
            left[k] -= factors @ rows.rhs[near]
            tolerance[k] += np.abs(factors) @ rows.tolerance[near]
    return decided, left, tolerance


def _parallel_pairs(matrix: sp.csr_matrix, gram: sp.csr_matrix) -> tuple[Numbers, Numbers, Vector]:
    """Return pairs i < j of rows (p,) that are parallel with all terms, and their directions."""
    upper, length = sp.triu(gram, 1).tocoo(), np.sqrt(gram.diagonal())
    near = np.abs(upper.data) > (1.0 - PARALLEL) * length[upper.row] * length[upper.col]
    i, j = upper.row[near].astype(np.int64), upper.col[near].astype(np.int64)
    size = np.sqrt(np.asarray(matrix.power(2).sum(axis=1)).ravel())
    cosine = np.asarray(matrix[i].multiply(matrix[j]).sum(axis=1)).ravel() / (size[i] * size[j])
    parallel = np.abs(cosine) > 1.0 - PARALLEL
    return i[parallel], j[parallel], np.sign(cosine[parallel])


def _components(i: Numbers, j: Numbers, size: int) -> Numbers:
    """Return the connected component of each of `size` things that pairs (i, j) connect."""
    graph = sp.coo_matrix((np.ones(i.size), (i, j)), (size, size))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _first_of_groups(group: Numbers, *keys: Array) -> Numbers:
    """Return the position of the first one of each member's group; the last key counts most."""
    order = np.lexsort((*keys, group))
    _, start, member = np.unique(group[order], return_index=True, return_inverse=True)
    first = np.empty_like(order)
    first[order] = order[start][member.ravel()]
    return first


def _check_room(
    rows: Conditions,
    i: Numbers,
    j: Numbers,
    sign: Vector,
    contradicted: Mask,
    matrix: sp.csr_matrix,
    node: Numbers,
) -> None:
    """Check that opposite contact rows leave room, and that tied rows agree with other conditions.

    The pairs (p,) are parallel with a sign; `contradicted` (k,) are contact rows that tied rows
    violate, and `node` (n,) is that of each column. The data are the same on all ranks.
    """
    contact = ~rows.tied & (rows.site < 0) & ~rows.soft
    tolerance = rows.tolerance[i] + rows.tolerance[j]
    excess = sign * rows.rhs[i] - rows.rhs[j]
    excluded = i[contact[i] & contact[j] & (sign < 0.0) & (excess > tolerance)]
    differ = rows.tied[i] & rows.tied[j] & (np.abs(excess) > tolerance)
    contradicted = np.union1d(np.flatnonzero(contradicted), np.append(i[differ], j[differ]))

    def nodes_of(k: int) -> list[int]:
        columns = node[matrix[k].indices]
        return np.unique(columns[columns >= 0]).tolist()

    if excluded.size:
        raise InputError(
            f"{excluded.size} pairs of contact conditions exclude each other: they press on the "
            "same nodes from opposite sides and leave no room, the first at the nodes "
            f"{nodes_of(excluded[0])} (global numbers). Make more room between the contacts, or "
            "remove one of them"
        )
    if contradicted.size:
        raise InputError(
            f"{contradicted.size} conditions contradict tied ones of the same nodes, the first at "
            f"the nodes {nodes_of(contradicted[0])} (global numbers). Tie each surface once, and "
            "take tied nodes out of contacts that leave them no room"
        )
