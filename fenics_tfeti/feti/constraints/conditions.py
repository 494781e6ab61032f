"""Contact, tied and tangential rows: conditions between weighted means of the copies of nodes.

A condition is a sum over nodes, sum_k c_k'u(node_k) <= gap, or = gap where surfaces are tied: two
nodes with coefficients n and -n, one node with n for a rigid obstacle, a slave node and some master
nodes. It is divided by the length of its slave's sum, so that gaps are distances and
multipliers forces. Its row takes the weighted mean of the copies of each node. On glued
displacements that is the row of the chapter, and it is orthogonal to every contrast. Tangential
rows, of contact rows with friction, are terms of the same form (`friction`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.friction import check_slides, common_scale
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable, largest_coordinate
from fenics_tfeti.feti.constraints.redundancy import Conditions, Redundancy, Terms, find_redundant
from fenics_tfeti.feti.constraints.row_table import Kind, RowTable
from fenics_tfeti.feti.constraints.scaling import RIGID, unit_scale
from fenics_tfeti.feti.local.rigid_body_modes import possible_kernel
from fenics_tfeti.feti.system import ContactRows, TornSystem
from fenics_tfeti.feti.tolerances import GIVEN, SAME_VALUE, rounding
from fenics_tfeti.parallel import (
    Directory,
    concatenate_ranks,
    first_of_rank,
    raise_collectively,
    warn_on_first_rank,
)
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class ConditionRows:
    """The contact, tied and tangential rows that a rank gives, and those with entries on it."""

    entries: Entries  # on this rank
    # contact rows, tied rows, and tangential rows of the contact rows of this rank, with the data
    # of the rows of B that they have, and scales of their own
    given: RowTable
    share: Vector  # (conditions of this rank,): part of the row's force, with a sign
    sites: Numbers  # (contact rows of this rank with friction,): the sites that they have
    leads: Mask  # (contact rows of this rank with friction,): whether they are the first there
    tolerance: Vector  # (conditions of this rank,): rounding of their right-hand side, scaled
    local: RowTable  # rows with entries on this rank, once for each of their nodes there
    rhs: Vector  # right-hand sides of `given`, scaled
    local_rhs: Vector  # those of `local`
    infinite_gaps: int  # contact rows with an infinite gap, over all ranks
    redundancy: Redundancy

    @property
    def has_row(self) -> Mask:
        """Which of this rank's conditions have a row of B."""
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
    displacements violate it, two rows exclude each other, or the normal force of a frictional one
    is that of a tied row. Warns where it is that of a support.
    """
    comm = system.comm
    contacts, kind, (site, direction), normal = _all_conditions(system)
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
    tied, slip, bounded = kind == Kind.TIED, kind == Kind.TANGENT, np.zeros(gap.size, dtype=bool)
    bounded[slip] = np.repeat(system.friction.bound > 0.0, system.gdim - 1)
    # there is no friction where there is nothing to touch, and none of a normal force where the gap
    # stays open
    stays_open = ~free & (gap > tolerance)
    soft, has_springs = np.asarray(contacts.compliance)[:, 0] > 0.0, contacts.has_springs
    has_springs |= np.asarray(contacts.adhesion) > 0.0
    elastic = np.asarray(system.friction.compliance) > 0.0
    has_springs[slip] = np.repeat(elastic, system.gdim - 1)
    finite[slip] &= finite[normal[slip]] & (bounded[slip] | ~stays_open[normal[slip]])
    with raise_collectively(comm):
        decided = finite & ~free & ~slip & ~np.asarray(contacts.held) & ~soft
        _check_decided_rows(contacts, tied, gap, tolerance, decided)
        check_slides(contacts, direction, np.where(finite, gap, 0.0), tolerance, free)
    kept = finite & free
    scale = common_scale(unit_scale(np.where(kept, flexibility, 1.0)), direction, kept)
    number, area = first_of_rank(comm, gap.size)[0], np.asarray(contacts.area)
    redundancy = find_redundant(
        Conditions(
            number + np.arange(gap.size),
            scale,
            scale * gap,
            scale * tolerance,
            tied,
            np.where(np.isnan(area), contacts.length, area),
            site,
            direction,
            np.where(slip, number + normal, -1),
            bounded,
            has_springs,
            soft,
        ),
        _free_terms(system, terms, kept, number, directory),
        system.gdim,
        directory,
        comm,
    )
    kept &= redundancy.has_row
    closed = redundancy.closed | (~free & ~stays_open)
    _check_pressed(system, kept, free, closed[: system.contacts.size])

    own = kept & redundancy.own
    rows = np.full(gap.size, -1, dtype=np.int64)
    rows[own] = first + first_of_rank(comm, int(own.sum()))[0] + np.arange(own.sum())
    rhs = np.where(own, scale * gap, 0.0)
    own_rows = RowTable(rows, kind, contacts.contact, scale, site, direction)
    entries, local, local_rhs = _distribute(own_rows, rhs, terms, directory, copies)
    given = RowTable(*(redundancy.of_rows(comm, x) for x in own_rows.columns))
    # the free part of a condition may be a multiple of that of the row that it has
    given = replace(given, scale=scale)
    # that of the first contact at a site has the lowest number
    sites, own_sites = (
        x[slip].reshape(-1, system.gdim - 1).min(axis=1) for x in (given.site, site)
    )
    return ConditionRows(
        entries,
        given,
        redundancy.share,
        sites,
        sites == own_sites,
        scale * tolerance,
        local,
        redundancy.of_rows(comm, rhs),
        local_rhs,
        infinite_gaps,
        redundancy,
    )


def _free_rows(terms: _Terms, rows: int) -> tuple[Mask, Vector]:
    """Return which rows have a part that is not prescribed, and B D^{-1} B' of it."""
    squares = np.sum(terms.coefficients**2, axis=1)
    all2, free2, flexibility = np.zeros((3, rows))
    np.add.at(all2, terms.row, terms.length2)
    np.add.at(free2, terms.row, squares)
    np.add.at(flexibility, terms.row, squares / terms.weight)
    return free2 > SAME_VALUE**2 * all2, flexibility


def _distribute(
    given: RowTable, rhs: Vector, terms: _Terms, directory: Directory, copies: Copies
) -> tuple[Entries, RowTable, Vector]:
    """Send the rows of B to the ranks that hold their nodes; return what this rank gets."""
    kept = given.number[terms.row] >= 0
    row, coefficients = terms.row[kept], terms.coefficients / terms.weight[:, None]
    coefficients = coefficients[kept] * given.scale[row][:, None]
    nodes, coefficients, rhs, *columns = directory.forward(
        terms.node[kept], coefficients, rhs[row], *given.chosen(row).columns
    )
    local = RowTable(*columns)
    return _spread_over_copies(copies, nodes, local.number, coefficients), local, rhs


def _all_conditions(
    system: TornSystem,
) -> tuple[ContactRows, Numbers, tuple[Numbers, Numbers], Numbers]:
    """Return contact, tied and tangential rows, their kinds, sites and directions, contact rows.

    The contact rows of tangential ones are positions among this rank's, -1 of others. Collective.
    """
    friction, directions = system.friction, system.gdim - 1
    tangential = friction.tangential_rows(system.contacts)
    contacts = ContactRows.concatenate([system.contacts, system.tied, tangential])
    sizes = [system.contacts.size, system.tied.size, tangential.size]
    kind = np.repeat([int(k) for k in (Kind.CONTACT, Kind.TIED, Kind.TANGENT)], sizes)
    kind[np.asarray(contacts.held)] = Kind.HELD
    none = np.full(sizes[0] + sizes[1], -1, dtype=np.int64)
    sites = first_of_rank(system.comm, friction.size)[0] + np.arange(friction.size)
    return (
        contacts,
        kind,
        (
            np.append(none, np.repeat(sites, directions)),
            np.append(none, np.tile(np.arange(directions), friction.size)),
        ),
        np.append(none, np.repeat(friction.row, directions)),
    )


def _terms(
    system: TornSystem, contacts: ContactRows, directory: Directory, table: NodeTable
) -> _Terms:
    """Return the terms of this rank's rows. Collective."""
    row, node, coefficients = _added_up(contacts)
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


def _added_up(contacts: ContactRows) -> tuple[Numbers, Numbers, Vector]:
    """Return row, node and coefficients of each term, added up where a node is on both surfaces."""
    row, node = contacts.row, contacts.nodes
    coefficients = contacts.coefficients / contacts.length[row][:, None]
    order = np.lexsort((node, row))
    is_new = np.ones(row.size, dtype=bool)
    is_new[1:] = (np.diff(row[order]) != 0) | (np.diff(node[order]) != 0)
    if is_new.all():
        return row, node, coefficients
    first = np.flatnonzero(is_new)
    return row[order][first], node[order][first], np.add.reduceat(coefficients[order], first)


def _free_terms(
    system: TornSystem, terms: _Terms, kept: Mask, first: int, directory: Directory
) -> Terms:
    """Return the terms of the kept conditions, numbered from `first`. Collective.

    Those at rigid bodies are terms of the motions of the body.
    """
    gdim, modes = system.gdim, 3 * system.gdim - 3
    chosen = kept[terms.row] & np.any(terms.coefficients != 0.0, axis=1)
    row, node, c, weight = (
        column[chosen] for column in (terms.row, terms.node, terms.coefficients, terms.weight)
    )
    on_body = weight >= RIGID
    table = directory.table(*_rigid_motions(system))
    _, body, motions = directory.lookup(node[on_body], *table)
    soft, weight = np.repeat(row[~on_body], gdim), np.repeat(weight[~on_body], gdim)
    column = gdim * node[~on_body, None] + np.arange(gdim)
    moved = np.einsum("ta,tam->tm", c[on_body], motions)
    entries = Terms(
        first + np.append(soft, np.repeat(row[on_body], modes)),
        np.append(column, -1 - modes * body[:, None] - np.arange(modes)),
        np.append(c[~on_body], moved),
        np.append(1.0 / weight, np.zeros(moved.size)),
    )
    return entries.chosen(entries.value != 0.0)


def _rigid_motions(system: TornSystem) -> tuple[Numbers, Numbers, Vector]:
    """Return the nodes (k,) of rigid subdomains, the number of each's subdomain, and its motions.

    These are displacements (k, gdim, modes) of the node, zero for motions that are not free.
    """
    gdim, modes = system.gdim, 3 * system.gdim - 3
    first = first_of_rank(system.comm, len(system.subdomains))[0]
    rigid = [k for k, subdomain in enumerate(system.subdomains) if subdomain.is_rigid]
    nodes, number = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    motions = [np.zeros((0, gdim, modes))]
    for k in rigid:
        R = possible_kernel(system.subdomains[k])
        nodes.append(system.subdomains[k].nodes)
        number.append(np.full(nodes[-1].size, first + k))
        motions.append(np.pad(R, ((0, 0), (0, modes - R.shape[1]))).reshape(-1, gdim, modes))
    return np.concatenate(nodes), np.concatenate(number), np.concatenate(motions)


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


def _check_pressed(system: TornSystem, has_row: Mask, free: Mask, closed: Mask) -> None:
    """Check that the normal force is known where the bound of friction depends on it. Collective.

    `has_row` tells which conditions of this rank have rows, `free` which of them prescribed
    displacements do not decide, and `closed` which contact rows they or tied rows close.
    """
    friction, contacts, comm = system.friction, system.contacts, system.comm
    of_friction = has_row[contacts.size + system.tied.size :]
    slips = of_friction.reshape(friction.size, system.gdim - 1).any(axis=1)
    unknown = slips & closed[friction.row] & (np.asarray(friction.coefficient) > 0.0)
    by_ties, by_supports = (friction.row[unknown & mask[friction.row]] for mask in (free, ~free))
    with raise_collectively(comm):
        if by_ties.size:
            name = system.contact_name(int(contacts.contact[by_ties[0]]))
            raise InputError(
                f"friction: at {by_ties.size} contact rows of {name}, the first of slave node "
                f"{contacts.slave[by_ties[0]]}, the normal force is not known: tied rows hold the "
                "surfaces together along the normal and let them slip. Tie all directions, leave "
                "the contact or the tie out, or give a slip bound in place of a coefficient"
            )
    nodes, numbers = (
        concatenate_ranks(comm, x[by_supports]) for x in (contacts.slave, contacts.contact)
    )
    if nodes.size:
        names = ", ".join(system.contact_name(int(k)) for k in np.unique(numbers))
        warn_on_first_rank(
            comm,
            f"there is no friction at {nodes.size} nodes of {names}, the first with the global "
            f"numbers {np.unique(nodes)[:6].tolist()}: prescribed displacements close the gap "
            "there, so that the normal force is that of the support. Give a slip bound there, or "
            "take the nodes out of the contact or of the support",
        )
