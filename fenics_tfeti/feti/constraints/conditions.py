"""Contact, tied and tangential rows: conditions between weighted means of the copies of nodes.

A condition is a sum over nodes, sum_k c_k'u(node_k) <= gap, or = gap where surfaces are tied: two
nodes with coefficients n and -n, one node with n for a rigid obstacle, a slave node and some master
nodes. It is divided by the length of its slave's sum, so that gaps are distances and
multipliers forces. Its row takes the weighted mean of the copies of each node. On glued
displacements that is the row of the chapter, and it is orthogonal to every contrast. Tangential
rows, of contact rows with friction, are terms of the same form (`friction`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.friction import Tangential, check_slides, common_scale
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable, largest_coordinate
from fenics_tfeti.feti.constraints.redundancy import ContactConditions, Redundancy, find_redundant
from fenics_tfeti.feti.system import ContactRows, TornSystem
from fenics_tfeti.feti.tolerances import GIVEN, SAME_VALUE, rounding
from fenics_tfeti.parallel import Directory, first_of_rank, raise_collectively
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class ConditionRows:
    """The contact, tied and tangential rows that this rank gives, or that have entries on it.

    Attributes
    ----------
    entries : Entries
        Their entries on this rank.
    number : (r,) integer array
        Global row numbers: first the rows that this rank gives, then those that have entries here;
        numbers repeat.
    contact : (r,) integer array
        Number of the contact.
    scale : (r,) array
        Factor that makes B D^{-1} B' = 1 of the condition whose slave's sum has length 1.
    rhs : (r,) array
        Right-hand side, scaled.
    tolerance : (rows of this rank,) array
        Rounding of the right-hand sides of the rows that this rank gives, scaled.
    tied : (r,) bool array
        Whether it is an equality.
    tangential : Tangential
        Which rows are tangential rows.
    given_tied : (rows of this rank,) bool array
        Whether it is an equality, for the contact rows that this rank gives, after them its tied
        rows, and its tangential rows in the end.
    given_sites : (rows of this rank,) integer array
        Number of the site of each tangential row that this rank gives, -1 for others.
    kept : (rows of this rank,) bool array
        Those of them that became rows of B.
    infinite_gaps : int
        Number of contact rows with an infinite gap, over all ranks.
    redundancy : Redundancy
        Rows that others imply, and rows that are not orthogonal.
    """

    entries: Entries
    number: Numbers
    contact: Numbers
    scale: Vector
    rhs: Vector
    tolerance: Vector
    tied: Mask
    tangential: Tangential
    given_tied: Mask
    given_sites: Numbers
    kept: Mask
    infinite_gaps: int
    redundancy: Redundancy


@dataclass(frozen=True)
class _Terms:
    """The terms c_k'u(node_k) of this rank's conditions, the slave's sums of unit length.

    Attributes
    ----------
    row : (t,) integer array
        Row of this rank.
    node : (t,) integer array
        Global node number.
    coefficients : (t, gdim) array
        c_k of the components without prescribed displacement, 0 for the others.
    length2 : (t,) array
        c_k'c_k with the components of prescribed displacements.
    weight : (t,) array
        Sum of the weights of the node's copies.
    known : (t,) array
        The part of c_k'u(node_k) that prescribed displacements decide [m].
    size : (t,) array
        Sum of the magnitudes of its summands [m].
    """

    row: Numbers
    node: Numbers
    coefficients: Vector
    length2: Vector
    weight: Vector
    known: Vector
    size: Vector


def condition_rows(
    system: TornSystem, directory: Directory, copies: Copies, table: NodeTable, first: int
) -> ConditionRows:
    """Return contact and tied rows with B D^{-1} B' = 1, numbered from `first`. Collective.

    Raises
    ------
    InputError
        On all ranks, if a row names a node of no subdomain, prescribed displacements violate it, or
        two rows exclude each other.
    """
    contacts, tied, tangential = _all_conditions(system)
    terms = _terms(system, contacts, directory, table)
    # prescribed displacements go to the right-hand side: the row stays orthogonal to their rows
    gap = contacts.gap / contacts.length
    tolerance = np.abs(gap)
    np.subtract.at(gap, terms.row, terms.known)
    np.add.at(tolerance, terms.row, terms.size)
    tolerance = SAME_VALUE * tolerance + rounding(largest_coordinate(system), GIVEN)

    squares, norm2, free2 = np.zeros(gap.size), np.zeros(gap.size), np.zeros(gap.size)
    lengths2 = np.sum(terms.coefficients**2, axis=1)
    np.add.at(squares, terms.row, terms.length2)
    np.add.at(free2, terms.row, lengths2)
    np.add.at(norm2, terms.row, lengths2 / terms.weight)
    # what is left of a row that prescribed displacements decide may be rounding
    finite, free = np.isfinite(gap), free2 > SAME_VALUE**2 * squares
    infinite_gaps = int(system.comm.allreduce(int(np.count_nonzero(~finite))))
    # there is no friction where there is nothing to touch
    rubbing = np.repeat(system.friction.row, system.gdim - 1)
    finite[tangential.mask] &= finite[rubbing]
    decided = finite & ~free & ~tangential.mask
    with raise_collectively(system.comm):
        _check_decided_rows(contacts, tied, gap, tolerance, decided)
        check_slides(contacts, tangential, gap, tolerance, free)
    kept = finite & free
    scale = common_scale(1.0 / np.sqrt(np.where(kept, norm2, 1.0)), tangential, kept)
    redundancy = find_redundant(
        _conditions(terms, kept, scale, gap, tolerance, tied, tangential.mask),
        directory,
        system.comm,
    )
    kept &= ~redundancy.dropped

    number = np.full(gap.size, -1, dtype=np.int64)
    number[kept] = first + first_of_rank(system.comm, int(kept.sum()))[0] + np.arange(kept.sum())
    rhs, errors = np.where(kept, scale * gap, 0.0), scale * tolerance
    here = kept[terms.row]
    row = terms.row[here]
    coefficients = (terms.coefficients / terms.weight[:, None])[here] * scale[row][:, None]
    # the holders of a row's nodes need the row
    given = (
        number,
        contacts.contact,
        scale,
        rhs,
        tied,
        tangential.site,
        tangential.direction,
        tangential.bound,
    )
    nodes, coefficients, *held = directory.forward(
        terms.node[here], coefficients, *(column[row] for column in given)
    )
    entries = _spread_over_copies(copies, nodes, held[0], coefficients)
    number, contact, scale, rhs, equality, *of_site = (
        np.concatenate([own[kept], others]) for own, others in zip(given, held, strict=True)
    )
    return ConditionRows(
        entries,
        number,
        contact,
        scale,
        rhs,
        errors,
        equality,
        Tangential(*of_site),
        tied,
        tangential.site,
        kept,
        infinite_gaps,
        redundancy,
    )


def _all_conditions(system: TornSystem) -> tuple[ContactRows, Mask, Tangential]:
    """Return contact, tied and tangential rows, and which are which. Collective."""
    friction, directions = system.friction, system.gdim - 1
    tangential = friction.tangential_rows(system.contacts)
    contacts = ContactRows.concatenate([system.contacts, system.tied, tangential])
    before = contacts.size - tangential.size
    number = np.arange(contacts.size)
    tied = (number >= system.contacts.size) & (number < before)
    none = np.full(before, -1, dtype=np.int64)
    sites = first_of_rank(system.comm, friction.size)[0] + np.arange(friction.size)
    of_site = Tangential(
        np.append(none, np.repeat(sites, directions)),
        np.append(none, np.tile(np.arange(directions), friction.size)),
        np.append(none.astype(float), np.repeat(friction.bound, directions)),
    )
    return contacts, tied, of_site


def _terms(
    system: TornSystem, contacts: ContactRows, directory: Directory, table: NodeTable
) -> _Terms:
    """Return the terms of this rank's rows. Collective."""
    row, node = contacts.row, contacts.nodes
    coefficients = contacts.coefficients / contacts.length[row][:, None]
    found = table.lookup(directory, node)
    with raise_collectively(system.comm):
        _check_known(node, found.multiplicity)
    known = np.where(found.prescribed, coefficients * found.values, 0.0)
    return _Terms(
        row,
        node,
        np.where(found.prescribed, 0.0, coefficients),
        np.sum(coefficients**2, axis=1),
        found.weight,
        known.sum(axis=1),
        np.abs(known).sum(axis=1),
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
    """Return the kept rows in the coordinates D^{-1/2} of the nodes, where they have length 1."""
    chosen = kept[terms.row] & np.any(terms.coefficients != 0.0, axis=1)
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
    at = np.searchsorted(copies.nodes, nodes)
    term = np.repeat(np.arange(nodes.size), copies.count[at])
    start = np.cumsum(copies.count[at]) - copies.count[at]
    copy = order[first[at][term] + np.arange(term.size) - start[term]]
    gdim = coefficients.shape[1]
    columns = copies.unknown[copy][:, None] + np.arange(gdim)
    values = coefficients[term] * copies.weight[copy][:, None]
    nonzero = values != 0.0
    return Entries(
        np.repeat(rows[term], gdim).reshape(-1, gdim)[nonzero], columns[nonzero], values[nonzero]
    )


def _check_known(nodes: Numbers, multiplicity: Numbers) -> None:
    unknown = nodes[multiplicity == 0]
    if unknown.size:
        raise InputError(f"a contact or tied row names node {unknown[0]}, which is in no subdomain")


def _check_decided_rows(
    contacts: ContactRows, tied: Mask, gap: Vector, tolerance: Vector, decided: Mask
) -> None:
    """Check the rows that prescribed displacements alone decide."""
    excess = np.where(tied, np.abs(gap), -gap)
    violated = np.flatnonzero(decided & (excess > tolerance))
    if not violated.size:
        return
    k = violated[0]
    given = contacts.gap[k] / contacts.length[k]
    if tied[k]:
        raise InputError(
            f"prescribed displacements contradict {np.count_nonzero(tied[violated])} tied "
            f"conditions: at slave node {contacts.slave[k]} they leave a jump of {-gap[k]:g} m. "
            "Prescribe the same displacements on both surfaces, or take the nodes out of the pair"
        )
    raise InputError(
        f"prescribed displacements violate {violated.size} contact conditions: at slave node "
        f"{contacts.slave[k]} they close the gap of {given:g} m by {given - gap[k]:g} m. "
        "Prescribe less, or take the nodes out of the contact"
    )
