"""Gluing, Dirichlet and contact rows B = [B_E; B_I] with B D^{-1} B' = I (sec. 11.5, remark 11.1).

D holds a weight for each copy of a node; with weights of 1 this is (11.22). Everything follows from
global node numbers and weights. A node with k copies gets k - 1 contrasts for each component that
is free, k single entries for each component that is prescribed. A contact row takes the weighted
mean of the slave's copies minus that of the master's: on glued displacements it is the row of the
chapter, and it is orthogonal to every contrast. Rows of one node in several inequalities are not
orthogonal to each other; what repeats another row is dropped (see `redundancy`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.redundancy import ContactConditions, Redundancy, find_redundant
from fenics_tfeti.feti.system import ContactRows, TornSystem
from fenics_tfeti.feti.tolerances import SAME_VALUE
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank, raise_collectively

__all__ = ["Constraints", "Coupling", "build_constraints"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# a normal whose free part is shorter than this is a rounded normal of a prescribed direction
NEGLIGIBLE_NORMAL = 1e-10


@dataclass(frozen=True)
class Coupling:
    """Contact rows that are not orthogonal to all others: W in B D^{-1} B' = blockdiag(I, W).

    They share a node with other contact rows. All other rows, and rows of different blocks of W,
    are orthonormal.

    Attributes
    ----------
    numbers : (w,) integer array
        Global numbers of the coupled rows, ascending; the same on all ranks.
    gram : (w, w) scipy.sparse.csr_matrix
        W in this order, with a diagonal of 1; the same on all ranks. Singular if rows depend
        linearly on others (`Constraints.dependent`).
    rows : (h,) integer array
        Local positions of the coupled rows that this rank holds.
    positions : (h,) integer array
        Their positions in `numbers`.
    """

    numbers: Numbers
    gram: sp.csr_matrix
    rows: Numbers
    positions: Numbers

    @staticmethod
    def build(layout: DualLayout, numbers: Numbers, gram: sp.csr_matrix) -> Coupling:
        """Find the coupled rows that this rank holds."""
        positions = np.flatnonzero(np.isin(numbers, layout.numbers))
        return Coupling(numbers, gram, layout.local(numbers[positions]), positions)


@dataclass(frozen=True)
class Constraints:
    """B of Bu <= c (inequality rows) and Bu = c (equality rows), on this rank's torn unknowns.

    Attributes
    ----------
    matrix : (m, n) scipy.sparse.csr_matrix
        The columns of B for this rank's subdomains and all rows that have an entry there.
    layout : DualLayout
        Global numbers of the rows, and the ranks that share them.
    inequality : (i,) integer array
        Local positions of the inequality rows, ascending.
    contact : (i,) integer array
        Number of the contact that each of them belongs to.
    scale : (i,) array
        Factor t of each: the row is t (u_slave - u_master)'n, and t lambda is the normal force.
    own_rows : (contact rows of this rank,) integer array
        Local position of each contact row that this rank gave; -1 where prescribed displacements
        alone decide it or another row says the same.
    weights : (n,) array
        Diagonal of D for this rank's torn displacements.
    nodes : int
        Number of distinct nodes over all ranks.
    redundant, dependent : int
        Contact rows dropped because others imply them, and rows that depend linearly on others all
        the same (their forces are not unique; displacements and resultants are).
    coupling : Coupling
        Contact rows that are not orthogonal to all others.
    """

    matrix: sp.csr_matrix
    layout: DualLayout
    inequality: Numbers
    contact: Numbers
    scale: Vector
    own_rows: Numbers
    weights: Vector
    nodes: int
    redundant: int
    dependent: int
    coupling: Coupling

    @property
    def size(self) -> int:
        """Number of rows that this rank holds."""
        return int(self.matrix.shape[0])

    @property
    def equality(self) -> NDArray[np.bool_]:
        """Mask of the equality rows."""
        mask = np.ones(self.size, dtype=bool)
        mask[self.inequality] = False
        return mask

    @cached_property
    def row_lengths(self) -> Vector:
        """Euclidean norms of the rows of B over all ranks."""
        squares = self.matrix.multiply(self.matrix).sum(axis=1)
        return np.sqrt(self.layout.sum(np.asarray(squares).ravel()))

    def same_numbering(self, other: Constraints) -> bool:
        """Tell, on all ranks alike, whether multipliers mean the same rows in both."""
        same = np.array_equal(self.layout.numbers, other.layout.numbers) and np.array_equal(
            self.own_rows, other.own_rows
        )
        return bool(self.layout.comm.allreduce(same, MPI.LAND))

    def same_rows(self, other: Constraints) -> bool:
        """Tell, on all ranks alike, whether B and the contacts of its rows are the same."""
        same = (
            self.matrix.shape == other.matrix.shape
            and (self.matrix != other.matrix).nnz == 0
            and np.array_equal(self.contact, other.contact)
        )
        return self.same_numbering(other) and bool(self.layout.comm.allreduce(same, MPI.LAND))

    @property
    def owned_inequalities(self) -> int:
        """How many of the inequality rows, the first ones, this rank owns."""
        return int(np.searchsorted(self.inequality, self.layout.owned))


@dataclass(frozen=True)
class _Copies:
    """Copies of nodes on this rank, over all its subdomains."""

    node: Numbers  # position in `nodes`
    unknown: Numbers  # first torn unknown
    weight: Vector  # entry of D
    nodes: Numbers  # distinct global numbers
    count: Numbers  # copies of each distinct node on this rank


@dataclass(frozen=True)
class _NodeTable:
    """What is known of nodes at their places in the directory, or of those looked up there."""

    multiplicity: Numbers  # copies over all ranks
    weight: Vector  # sum of the copies' weights
    first_row: Numbers  # number of the node's first equality row
    prescribed: NDArray[np.bool_]  # (nodes, gdim)
    values: Vector  # (nodes, gdim)


@dataclass(frozen=True)
class _Entries:
    """Entries of B, with global row numbers, and the right-hand sides of some rows."""

    rows: Numbers
    columns: Numbers
    values: Vector


@dataclass(frozen=True)
class _InequalityRows:
    """Contact rows that remain, with what their multipliers need to know."""

    number: Numbers  # global row number
    contact: Numbers
    scale: Vector
    rhs: Vector


def build_constraints(
    system: TornSystem, weights: Vector | None = None
) -> tuple[Constraints, Vector]:
    """Build B and c from global node numbers.

    Parameters
    ----------
    system : TornSystem
        Subdomains, prescribed displacements and contact rows.
    weights : (torn nodes of this rank,) array, optional
        Positive weights of the copies, subdomain by subdomain; 1 by default.

    Returns
    -------
    Constraints
        This rank's part of B.
    (m,) array
        c.

    Raises
    ------
    InputError
        Contradictory prescribed displacements, a constraint on a node of no subdomain, a contact
        row that prescribed displacements violate, contact rows that exclude each other.
    """
    copies = _copies(system, weights)
    directory = Directory(system.comm, copies.nodes)
    table = _node_table(system, directory, copies)
    equality_total = first_of_rank(system.comm, _equality_rows(table).sum())[1]

    local = _lookup(directory, copies.nodes, table)
    equality, equality_rhs = _equality_entries(system, directory, copies, local)
    inequality, rows, kept, redundancy = _inequality_entries(
        system, directory, copies, table, int(equality_total)
    )

    layout = DualLayout(system.comm, np.unique(np.concatenate([equality.rows, rows.number])))
    n = sum(subdomain.size for subdomain in system.subdomains)
    matrix = sp.csr_matrix(
        (
            np.concatenate([equality.values, inequality.values]),
            (
                layout.local(np.concatenate([equality.rows, inequality.rows])),
                np.concatenate([equality.columns, inequality.columns]),
            ),
        ),
        shape=(layout.numbers.size, n),
    )
    values = np.zeros(layout.numbers.size)
    prescribed = layout.local(equality_rhs[0].astype(np.int64))
    values[prescribed] = equality_rhs[1]
    at = layout.local(rows.number)
    values[at] = rows.rhs
    own_rows = np.full(system.contacts.slave.size, -1, dtype=np.int64)
    own_rows[kept] = at[: np.count_nonzero(kept)]
    # a holder learns of its row once or several times, always the same
    at, first = np.unique(at, return_index=True)
    constraints = Constraints(
        matrix,
        layout,
        inequality=at,
        contact=rows.contact[first],
        scale=rows.scale[first],
        own_rows=own_rows,
        weights=np.repeat(copies.weight, system.gdim),
        nodes=first_of_rank(system.comm, directory.keys.size)[1],
        redundant=redundancy.dropped_total,
        dependent=redundancy.dependent,
        coupling=Coupling.build(
            layout,
            concatenate_ranks(system.comm, rows.number[: kept.sum()][redundancy.coupled[kept]]),
            redundancy.gram,
        ),
    )
    return constraints, values


def _copies(system: TornSystem, weights: Vector | None) -> _Copies:
    sizes = np.array([s.nodes.size for s in system.subdomains], dtype=np.int64)
    all_nodes = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in system.subdomains)])
    nodes, node, count = np.unique(all_nodes, return_inverse=True, return_counts=True)
    unknown = system.gdim * np.arange(sizes.sum(), dtype=np.int64)
    weight = np.ones(all_nodes.size) if weights is None else weights
    return _Copies(node.ravel(), unknown, weight, nodes, count)


def _equality_rows(table: _NodeTable) -> Numbers:
    """Return the number of equality rows of each node."""
    k = table.multiplicity[:, None]
    rows: Numbers = np.where(table.prescribed, k, k - 1).sum(axis=1)
    return rows


def _node_table(system: TornSystem, directory: Directory, copies: _Copies) -> _NodeTable:
    """Gather multiplicities and prescribed displacements at the nodes' places; number the rows."""
    places = directory.keys.size
    sums = np.bincount(copies.node, weights=copies.weight, minlength=copies.nodes.size)
    keys, counts, sums = directory.collect(copies.nodes, copies.count, sums)
    multiplicity, weight = np.zeros(places, dtype=np.int64), np.zeros(places)
    np.add.at(multiplicity, directory.position(keys), counts)
    np.add.at(weight, directory.position(keys), sums)

    keys, components, values = directory.collect(
        system.prescribed.nodes, system.prescribed.components, system.prescribed.values
    )
    with raise_collectively(system.comm):
        prescribed, merged = _merge_prescribed(
            directory, keys, components, values, (places, system.gdim)
        )
    unnumbered = _NodeTable(multiplicity, weight, multiplicity, prescribed, merged)
    rows = _equality_rows(unnumbered)
    first = first_of_rank(system.comm, int(rows.sum()))[0] + np.cumsum(rows) - rows
    return _NodeTable(multiplicity, weight, first.astype(np.int64), prescribed, merged)


def _merge_prescribed(
    directory: Directory,
    keys: Numbers,
    components: Numbers,
    values: Vector,
    shape: tuple[int, int],
) -> tuple[NDArray[np.bool_], Vector]:
    at = directory.position(keys)
    if np.any(at < 0):
        raise InputError(
            f"a displacement is prescribed for node {keys[at < 0][0]}, which is in no subdomain"
        )
    prescribed = np.zeros(shape, dtype=bool)
    merged = np.zeros(shape)
    prescribed[at, components] = True
    merged[at, components] = values
    difference = np.abs(merged[at, components] - values)
    wrong = np.flatnonzero(difference > SAME_VALUE * np.abs(values).max(initial=0.0))
    if wrong.size:
        k = wrong[0]
        raise InputError(
            f"contradictory Dirichlet values: component {components[k]} of node {keys[k]} is "
            f"prescribed as {values[k]:g} and as {merged[at[k], components[k]]:g} "
            f"({wrong.size} such contradictions). Give each displacement one value"
        )
    return prescribed, merged


def _lookup(directory: Directory, nodes: Numbers, table: _NodeTable) -> _NodeTable:
    tables = (table.multiplicity, table.weight, table.first_row, table.prescribed, table.values)
    return _NodeTable(*directory.lookup(nodes, *tables)[1:])


@dataclass(frozen=True)
class _Chain:
    """The copies of each node that is held here, of all ranks, ordered within their node."""

    node: Numbers  # position in the nodes held here
    number: Numbers  # 0, 1, ..., k - 1
    own: Numbers  # the copy on this rank, -1 for those of other ranks
    weight: Vector
    before: Vector  # sum of the weights of the copies before it


def _chain(directory: Directory, copies: _Copies, rank: int) -> _Chain:
    """Bring the copies of all ranks into one order, the same on all ranks."""
    own = np.arange(copies.node.size)
    keys, ranks, own, weight = directory.forward(
        copies.nodes[copies.node], np.full(own.size, rank, dtype=np.int64), own, copies.weight
    )
    order = np.lexsort((own, ranks, keys))
    keys, ranks, own, weight = keys[order], ranks[order], own[order], weight[order]
    node = np.searchsorted(copies.nodes, keys)
    number = np.arange(keys.size) - np.searchsorted(keys, keys)
    before = np.zeros(keys.size)
    for r in range(1, int(number.max(initial=0)) + 1):
        at = np.flatnonzero(number == r)
        before[at] = before[at - 1] + weight[at - 1]
    return _Chain(node, number, np.where(ranks == rank, own, -1), weight, before)


def _equality_entries(
    system: TornSystem, directory: Directory, copies: _Copies, local: _NodeTable
) -> tuple[_Entries, tuple[Numbers, Vector]]:
    """Return the Dirichlet and gluing entries, and (rows, values) of prescribed displacements."""
    chain = _chain(directory, copies, system.comm.rank)
    here = chain.own >= 0
    number = np.empty(copies.node.size, dtype=np.int64)
    number[chain.own[here]] = chain.number[here]
    contrasts = _contrasts(chain, local.multiplicity)
    row = local.first_row[copies.node]
    parts: list[_Entries] = []
    rhs_rows: list[Numbers] = []
    rhs_values: list[Vector] = []
    for component in range(system.gdim):
        prescribed = local.prescribed[copies.node, component]
        unknown = copies.unknown + component

        rows, root = (row + number)[prescribed], np.sqrt(copies.weight[prescribed])
        parts.append(_Entries(rows, unknown[prescribed], root))
        rhs_rows.append(rows)
        rhs_values.append(root * local.values[copies.node[prescribed], component])

        copy = contrasts.columns[~prescribed[contrasts.columns]]
        glued = ~prescribed[contrasts.columns]
        parts.append(
            _Entries(row[copy] + contrasts.rows[glued], unknown[copy], contrasts.values[glued])
        )
        k = local.multiplicity[copies.node]
        row = row + np.where(prescribed, k, k - 1)
    entries = _Entries(
        np.concatenate([p.rows for p in parts]),
        np.concatenate([p.columns for p in parts]),
        np.concatenate([p.values for p in parts]),
    )
    return entries, (np.concatenate(rhs_rows), np.concatenate(rhs_values))


def _contrasts(chain: _Chain, multiplicity: Numbers) -> _Entries:
    """Contrasts c_r with c_r D^{-1} c_s' = delta_rs: copy r against the mean of the copies before.

    With weights d_0, d_1, ... and s_r = d_0 + ... + d_{r-1}, row r = 1, ..., k - 1 is
    (d_0, ..., d_{r-1}, -s_r, 0, ..., 0) / s_r / sqrt(1 / s_r + 1 / d_r); Helmert's for weights 1.

    Returns
    -------
    _Entries
        Rows counted from 0 within the node, columns as copies on this rank.
    """
    mine = np.flatnonzero(chain.own >= 0)
    number = chain.number[mine]
    first = np.maximum(number, 1)
    rows_of_copy = multiplicity[chain.node[mine]] - first
    term = np.repeat(np.arange(mine.size), rows_of_copy)
    start = np.cumsum(rows_of_copy) - rows_of_copy
    r = (np.arange(term.size) - start[term] + first[term]).astype(np.int64)
    of_row = mine[term] - number[term] + r  # the place of copy r in the chain
    s, d = chain.before[of_row], chain.weight[of_row]
    values = np.where(r == number[term], -1.0, chain.weight[mine[term]] / s)
    return _Entries(r - 1, chain.own[mine[term]], values / np.sqrt(1.0 / s + 1.0 / d))


def _inequality_entries(
    system: TornSystem,
    directory: Directory,
    copies: _Copies,
    table: _NodeTable,
    equality_total: int,
) -> tuple[_Entries, _InequalityRows, NDArray[np.bool_], Redundancy]:
    """Return the contact entries, the rows this rank holds (own ones first), and who is kept."""
    contacts = system.contacts
    sides = []  # (nodes, coefficients, weight) of slave and master
    gap = contacts.gap.copy()
    for nodes, sign in ((contacts.slave, 1.0), (contacts.master, -1.0)):
        found = _lookup(directory, nodes.clip(min=0), table)
        there = nodes >= 0
        with raise_collectively(system.comm):
            _check_known(nodes[there], found.multiplicity[there])
        coefficients = sign * contacts.normal * there[:, None]
        # a prescribed component is known: move it to the gap, so the row stays orthogonal to its
        gap -= np.sum(np.where(found.prescribed, coefficients * found.values, 0.0), axis=1)
        coefficients = np.where(found.prescribed, 0.0, coefficients)
        sides.append((nodes, coefficients, np.where(there, found.weight, 1.0)))
    # negligible is meant without weights: of a unit normal
    kept = sum(np.sum(c**2, axis=1) for _, c, _ in sides) > NEGLIGIBLE_NORMAL**2
    with raise_collectively(system.comm):
        _check_decided_rows(contacts, gap, kept)
    norm2 = np.where(kept, sum(np.sum(c**2, axis=1) / w for _, c, w in sides), 1.0)
    redundancy = find_redundant(
        ContactConditions(sides, 1.0 / np.sqrt(norm2), gap, kept), directory, system.comm
    )
    kept &= ~redundancy.dropped

    first = equality_total + first_of_rank(system.comm, int(kept.sum()))[0]
    number = np.arange(first, first + int(kept.sum()), dtype=np.int64)
    scale = 1.0 / np.sqrt(norm2[kept])
    rows = _InequalityRows(number, contacts.contact[kept], scale, scale * gap[kept])
    arrived = [_forward_side(directory, side, kept, rows) for side in sides]
    entries = [_spread_over_copies(copies, a[0], a[1], a[2]) for a in arrived]
    held = _InequalityRows(
        np.concatenate([rows.number, *(a[1] for a in arrived)]),
        np.concatenate([rows.contact, *(a[3] for a in arrived)]),
        np.concatenate([rows.scale, *(a[4] for a in arrived)]),
        np.concatenate([rows.rhs, *(a[5] for a in arrived)]),
    )
    merged = _Entries(
        np.concatenate([e.rows for e in entries]),
        np.concatenate([e.columns for e in entries]),
        np.concatenate([e.values for e in entries]),
    )
    return merged, held, kept, redundancy


def _forward_side(
    directory: Directory,
    side: tuple[Numbers, Vector, Vector],
    kept: NDArray[np.bool_],
    rows: _InequalityRows,
) -> tuple[NDArray[Any], ...]:
    """Tell the holders of the side's nodes about their rows: (node, row, coefficients, ...)."""
    nodes, coefficients, weight = side
    there = nodes[kept] >= 0
    part = (coefficients / weight[:, None])[kept] * rows.scale[:, None]
    return directory.forward(
        nodes[kept][there],
        rows.number[there],
        part[there],
        rows.contact[there],
        rows.scale[there],
        rows.rhs[there],
    )


def _spread_over_copies(
    copies: _Copies, nodes: Numbers, rows: Numbers, coefficients: Vector
) -> _Entries:
    """Give every local copy of the nodes the row's coefficients times its weight."""
    order = np.argsort(copies.node, kind="stable")
    first = np.cumsum(copies.count) - copies.count
    at = np.searchsorted(copies.nodes, nodes)
    term = np.repeat(np.arange(nodes.size), copies.count[at])
    start = np.cumsum(copies.count[at]) - copies.count[at]
    copy = order[first[at][term] + np.arange(term.size) - start[term]]
    gdim = coefficients.shape[1]
    columns = copies.unknown[copy][:, None] + np.arange(gdim)
    values = coefficients[term] * copies.weight[copy][:, None]
    nonzero = values != 0.0
    return _Entries(
        np.repeat(rows[term], gdim).reshape(-1, gdim)[nonzero], columns[nonzero], values[nonzero]
    )


def _check_known(nodes: Numbers, multiplicity: Numbers) -> None:
    unknown = nodes[multiplicity == 0]
    if unknown.size:
        raise InputError(f"a contact row names node {unknown[0]}, which is in no subdomain")


def _check_decided_rows(contacts: ContactRows, gap: Vector, kept: NDArray[np.bool_]) -> None:
    """Check the rows that prescribed displacements alone decide."""
    scale = max(float(np.abs(contacts.gap).max(initial=0.0)), float(np.abs(gap).max(initial=0.0)))
    violated = np.flatnonzero(~kept & (gap < -SAME_VALUE * scale))
    if violated.size:
        k = violated[0]
        raise InputError(
            f"prescribed displacements violate {violated.size} contact conditions: at slave node "
            f"{contacts.slave[k]} they close the gap of {contacts.gap[k]:g} m by "
            f"{contacts.gap[k] - gap[k]:g} m. Prescribe less, or take the nodes out of the contact"
        )
