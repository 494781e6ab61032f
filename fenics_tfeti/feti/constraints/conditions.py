"""Contact, tied and tangential rows: conditions between weighted means of the copies of nodes.

A condition is a sum over nodes, sum_k c_k'u(node_k) <= gap, or = gap where surfaces are tied: two
nodes with coefficients n and -n, one node with n for a rigid obstacle, a slave node and some master
nodes. It is divided by the length of its slave's sum, so that gaps are distances and
multipliers forces. Its row takes the weighted mean of the copies of each node. On glued
displacements that is the row of the chapter, and it is orthogonal to every contrast. Tangential
rows, of contact rows with friction, are terms of the same form (`friction`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.friction import Tangential, check_slides, common_scale
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable, largest_coordinate
from fenics_tfeti.feti.constraints.redundancy import ContactConditions, Redundancy, find_redundant
from fenics_tfeti.feti.constraints.scaling import RIGID, unit_scale
from fenics_tfeti.feti.system import ContactRows, TornSystem
from fenics_tfeti.feti.tolerances import GIVEN, SAME_VALUE, rounding
from fenics_tfeti.parallel import Directory, first_of_rank, raise_collectively
from fenics_tfeti.typing import Array, Mask, Numbers, Vector


@dataclass(frozen=True)
class RowData:
    """Data of contact, tied and tangential rows."""

    number: Numbers  # (r,): global row number; -1 of a condition that is no row of B
    contact: Numbers  # (r,): number of the contact
    scale: Vector  # (r,): makes B D^{-1} B' = 1 of the condition whose slave's sum has length 1
    rhs: Vector  # (r,): right-hand side, scaled
    tied: Mask  # (r,): whether it is an equality
    tangential: Tangential

    @staticmethod
    def from_columns(columns: Sequence[Array]) -> RowData:
        """Return the rows with `columns` of all data."""
        number, contact, scale, rhs, tied, *tangential = columns
        return RowData(number, contact, scale, rhs, tied, Tangential(*tangential))

    @property
    def columns(self) -> list[Array]:
        """All data as columns (r,)."""
        data = vars(self).copy()
        tangential = data.pop("tangential")
        return [*data.values(), *vars(tangential).values()]

    def chosen(self, rows: Numbers | Mask) -> RowData:
        """Return the data of some rows."""
        return RowData.from_columns([column[rows] for column in self.columns])

    def concatenate(self, rows: RowData) -> RowData:
        """Return these rows with others behind them."""
        pairs = zip(self.columns, rows.columns, strict=True)
        return RowData.from_columns([np.concatenate(pair) for pair in pairs])


@dataclass(frozen=True)
class ConditionRows:
    """The contact, tied and tangential rows that a rank gives, and those with entries on it."""

    entries: Entries  # on this rank
    given: RowData  # contact rows, tied rows, and tangential rows of the contact rows of this rank
    tolerance: Vector  # (conditions of this rank,): rounding of their right-hand sides, scaled
    local: RowData  # rows with entries on this rank, once for each of their nodes there
    infinite_gaps: int  # contact rows with an infinite gap, over all ranks
    redundancy: Redundancy

    @property
    def kept(self) -> Mask:
        """Which of this rank's conditions became rows of B."""
        return self.given.number >= 0


@dataclass(frozen=True)
class _Terms:
    """The terms c_k'u(node_k) of this rank's conditions, the slave's sums of unit length.

    The coefficients (t, gdim) are 0 for components with a prescribed displacement, `length2` is
    c_k'c_k with these components, `prescribed` the part of c_k'u(node_k) that they decide [m] and
    `size` the sum of the magnitudes of its summands; `weight` is the sum of the weights of the
    node's copies.
    """

    row: Numbers
    node: Numbers
    coefficients: Vector
    length2: Vector
    weight: Vector
    prescribed: Vector
    size: Vector


def condition_rows(
    system: TornSystem, directory: Directory, copies: Copies, table: NodeTable, first: int
) -> ConditionRows:
    """Return contact and tied rows with B D^{-1} B' = 1, numbered from `first`. Collective.

    Raises an InputError on all ranks if a row names a node of no subdomain, prescribed
    displacements violate it, or two rows exclude each other.
    """
    comm = system.comm
    contacts, tied, tangential = _all_conditions(system)
    terms = _terms(system, contacts, directory, table)
    # prescribed displacements go to the right-hand side: the row stays orthogonal to their rows
    gap = contacts.gap / contacts.length
    tolerance = np.abs(gap)
    np.subtract.at(gap, terms.row, terms.prescribed)
    np.add.at(tolerance, terms.row, terms.size)
    tolerance = SAME_VALUE * tolerance + rounding(largest_coordinate(system), GIVEN)

    free, flexibility = _free_rows(terms, gap.size)
    finite = np.isfinite(gap)
    infinite_gaps = int(comm.allreduce(int(np.count_nonzero(~finite))))
    # there is no friction where there is nothing to touch
    finite[tangential.mask] &= finite[np.repeat(system.friction.row, system.gdim - 1)]
    with raise_collectively(comm):
        _check_decided_rows(contacts, tied, gap, tolerance, finite & ~free & ~tangential.mask)
        check_slides(contacts, tangential, gap, tolerance, free)
    kept = finite & free
    scale = common_scale(unit_scale(np.where(kept, flexibility, 1.0)), tangential, kept)
    redundancy = find_redundant(
        _conditions(terms, kept, scale, gap, tolerance, tied, tangential.mask), directory, comm
    )
    kept &= ~redundancy.dropped

    number = np.full(gap.size, -1, dtype=np.int64)
    number[kept] = first + first_of_rank(comm, int(kept.sum()))[0] + np.arange(kept.sum())
    rhs = np.where(kept, scale * gap, 0.0)
    given = RowData(number, contacts.contact, scale, rhs, tied, tangential)
    entries, local = _distribute(given, terms, directory, copies)
    return ConditionRows(entries, given, scale * tolerance, local, infinite_gaps, redundancy)


def _free_rows(terms: _Terms, rows: int) -> tuple[Mask, Vector]:
    """Return which rows have a part that is not prescribed, and B D^{-1} B' of it."""
    squares = np.sum(terms.coefficients**2, axis=1)
    all2, free2, flexibility = np.zeros((3, rows))
    np.add.at(all2, terms.row, terms.length2)
    np.add.at(free2, terms.row, squares)
    np.add.at(flexibility, terms.row, squares / terms.weight)
    return free2 > SAME_VALUE**2 * all2, flexibility


def _distribute(
    given: RowData, terms: _Terms, directory: Directory, copies: Copies
) -> tuple[Entries, RowData]:
    """Send the rows of B to the ranks that hold their nodes; return what this rank gets."""
    kept = given.number[terms.row] >= 0
    row, coefficients = terms.row[kept], terms.coefficients / terms.weight[:, None]
    coefficients = coefficients[kept] * given.scale[row][:, None]
    nodes, coefficients, *columns = directory.forward(
        terms.node[kept], coefficients, *given.chosen(row).columns
    )
    local = RowData.from_columns(columns)
    return _spread_over_copies(copies, nodes, local.number, coefficients), local


def _all_conditions(system: TornSystem) -> tuple[ContactRows, Mask, Tangential]:
    """Return contact, tied and tangential rows, and which are which. Collective."""
    friction, directions = system.friction, system.gdim - 1
    tangential = friction.tangential_rows(system.contacts)
    contacts = ContactRows.concatenate([system.contacts, system.tied, tangential])
    sizes = [system.contacts.size, system.tied.size, tangential.size]
    tied = np.repeat([False, True, False], sizes)
    none = np.full(sizes[0] + sizes[1], -1, dtype=np.int64)
    sites = first_of_rank(system.comm, friction.size)[0] + np.arange(friction.size)
    return (
        contacts,
        tied,
        Tangential(
            np.append(none, np.repeat(sites, directions)),
            np.append(none, np.tile(np.arange(directions), friction.size)),
            np.append(none.astype(float), np.repeat(friction.bound, directions)),
        ),
    )


def _terms(
    system: TornSystem, contacts: ContactRows, directory: Directory, table: NodeTable
) -> _Terms:
    """Return the terms of this rank's rows. Collective."""
    row, node = contacts.row, contacts.nodes
    coefficients = contacts.coefficients / contacts.length[row][:, None]
    nodal = table.lookup(directory, node)
    with raise_collectively(system.comm):
        _check_known(node, nodal.multiplicity)
    summands = np.where(nodal.prescribed, coefficients * nodal.values, 0.0)
    return _Terms(
        row,
        node,
        np.where(nodal.prescribed, 0.0, coefficients),
        np.sum(coefficients**2, axis=1),
        nodal.weight,
        summands.sum(axis=1),
        np.abs(summands).sum(axis=1),
    )


def _conditions(
    terms: _Terms,
    kept: Mask,
    scale: Vector,
    gap: Vector,
    tolerance: Vector,
    tied: Mask,
    tangential: Mask,
) -> ContactConditions:
    """Return the kept rows in the coordinates D^{-1/2} of the nodes, where they have length 1.

    There rigid bodies have no part in them.
    """
    chosen = kept[terms.row] & np.any(terms.coefficients != 0.0, axis=1) & (terms.weight < RIGID)
    row = terms.row[chosen]
    factor = scale[row] / np.sqrt(terms.weight[chosen])
    return ContactConditions(
        row,
        terms.node[chosen],
        terms.coefficients[chosen] * factor[:, None],
        scale * gap,
        scale * tolerance,
        tied,
        tangential,
    )


def _spread_over_copies(
    copies: Copies, nodes: Numbers, rows: Numbers, coefficients: Vector
) -> Entries:
    """Give every local copy of the nodes the row's coefficients times its weight."""
    order = np.argsort(copies.node, kind="stable")
    first = np.cumsum(copies.count) - copies.count
    position = np.searchsorted(copies.nodes, nodes)
    term = np.repeat(np.arange(nodes.size), copies.count[position])
    start = np.cumsum(copies.count[position]) - copies.count[position]
    copy = order[first[position][term] + np.arange(term.size) - start[term]]
    gdim = coefficients.shape[1]
    columns = copies.unknown[copy][:, None] + np.arange(gdim)
    values = coefficients[term] * copies.weight[copy][:, None]
    nonzero = values != 0.0
    return Entries(
        np.repeat(rows[term], gdim).reshape(-1, gdim)[nonzero], columns[nonzero], values[nonzero]
    )


def _check_known(nodes: Numbers, multiplicity: Numbers) -> None:
    lost = nodes[multiplicity == 0]
    if lost.size:
        raise InputError(f"a contact or tied row names node {lost[0]}, which is in no subdomain")


def _check_decided_rows(
    contacts: ContactRows, tied: Mask, gap: Vector, tolerance: Vector, decided: Mask
) -> None:
    """Check the rows that prescribed displacements alone decide."""
    excess = np.where(tied, np.abs(gap), -gap)
    violated = np.flatnonzero(decided & (excess > tolerance))
    if not violated.size:
        return
    k = violated[0]
    distance = contacts.gap[k] / contacts.length[k]
    if tied[k]:
        raise InputError(
            f"prescribed displacements contradict {np.count_nonzero(tied[violated])} tied "
            f"conditions: at slave node {contacts.slave[k]} they leave a jump of {-gap[k]:g}. "
            "Prescribe the same displacements on both surfaces, or take the nodes out of the pair"
        )
    raise InputError(
        f"prescribed displacements violate {violated.size} contact conditions: at slave node "
        f"{contacts.slave[k]} they close the gap of {distance:g} by {distance - gap[k]:g}. "
        "Prescribe less, or take the nodes out of the contact"
    )
