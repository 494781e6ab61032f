"""Constraint rows B = [B_E; B_I; B_T] with B D^{-1} B' = blockdiag(I, W) (sec. 11.5, remark 11.1).

D holds a weight for each copy of a node; with weights of 1 this is (11.22). Rows follow from global
node numbers and weights alone: gluing and Dirichlet rows by `equality`, contact and tied rows by
`conditions`. W differs from the identity only for those that share a node (`coupling`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fenics_tfeti.feti.constraints.conditions import ConditionRows, condition_rows
from fenics_tfeti.feti.constraints.coupling import Coupling
from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.entries import Entries
from fenics_tfeti.feti.constraints.equality import equality_rows
from fenics_tfeti.feti.constraints.friction import FrictionRows
from fenics_tfeti.feti.constraints.nodes import Copies, NodeTable
from fenics_tfeti.feti.constraints.row_table import GivenRows, Kind, RowTable
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class Constraints:
    """B of Bu <= c (inequality rows) and Bu = c (equality rows), on this rank's torn unknowns.

    Friction has rows of its own, whose jumps Bu - c are slips. A contact row is t times the
    condition whose slave's sum has length 1: its jump divided by t is a distance [m], and t lambda
    is the normal force [N].
    """

    matrix: sp.csr_matrix  # (m, n): columns of this rank's subdomains, all rows with an entry there
    layout: DualLayout  # global numbers of the rows, and the ranks that share them
    rows: RowTable  # contact, tied and tangential rows that this rank holds, by local positions
    contacts: GivenRows  # the contact rows that this rank gave
    tied: GivenRows  # the tied rows that this rank gave
    weights: Vector  # (n,): diagonal of D for this rank's torn displacements
    nodes: int  # distinct nodes over all ranks
    redundant: int  # contact and tied rows that others imply or equal
    infinite_gaps: int  # contact rows dropped because their gap is infinite
    coupling: Coupling  # contact, tied and tangential rows that are not orthogonal to all others
    friction: FrictionRows

    @cached_property
    def inequality(self) -> Numbers:
        """Local positions (i,) of the inequality rows, ascending."""
        return self.rows.where(Kind.CONTACT)

    @property
    def held(self) -> Mask:
        """Which contact rows that this rank gave hold with equality."""
        return np.isin(self.contacts.own_rows, self.rows.where(Kind.HELD))

    @property
    def size(self) -> int:
        """Number of rows that this rank holds."""
        return int(self.matrix.shape[0])

    @property
    def dependent(self) -> int:
        """Number of contact and tied rows that depend linearly on others.

        Their forces are not unique; displacements and resultants are.
        """
        return self.coupling.dependent

    @property
    def equality(self) -> NDArray[np.bool_]:
        """Mask of the equality rows."""
        mask = np.ones(self.size, dtype=bool)
        mask[self._bounded] = False
        return mask

    @cached_property
    def _bounded(self) -> Numbers:
        """Local positions of the rows that are no equalities."""
        return self.rows.where(Kind.CONTACT, Kind.TANGENT)

    def lengths_of_rows(self) -> Vector:
        """Return the Euclidean norms (m,) of the rows of B over all ranks. Collective at first."""
        return self._lengths

    @cached_property
    def _lengths(self) -> Vector:
        squares = self.matrix.multiply(self.matrix).sum(axis=1)
        return np.sqrt(self.layout.sum(np.asarray(squares).ravel()))

    def same_numbering(self, other: Constraints) -> bool:
        """Tell, with one answer on all ranks, whether both number the same rows alike."""
        pairs = (
            (self.layout.numbers, other.layout.numbers),
            (self.rows.number, other.rows.number),
            (self.rows.kind, other.rows.kind),
            (self.contacts.own_rows, other.contacts.own_rows),
            (self.tied.own_rows, other.tied.own_rows),
            (self.friction.rows, other.friction.rows),
            (self.friction.own, other.friction.own),
            (self.friction.normal, other.friction.normal),
        )
        same = all(np.array_equal(*pair) for pair in pairs)
        return bool(self.layout.comm.allreduce(same, MPI.LAND))

    def same_rows(self, other: Constraints) -> bool:
        """Tell, with one answer on all ranks, whether B and its rows' contacts are equal."""
        same = (
            self.matrix.shape == other.matrix.shape
            and (self.matrix != other.matrix).nnz == 0
            and np.array_equal(self.rows.contact, other.rows.contact)
            and np.array_equal(self.contacts.share, other.contacts.share)
            and np.array_equal(self.tied.share, other.tied.share)
        )
        return self.same_numbering(other) and bool(self.layout.comm.allreduce(same, MPI.LAND))

    @property
    def owned_inequalities(self) -> int:
        """Number of inequality rows that this rank owns; they come first."""
        return int(np.searchsorted(self.inequality, self.layout.owned))

    @property
    def owned_contact_rows(self) -> Numbers:
        """Local positions of the inequality rows that this rank owns, ascending."""
        return self.inequality[: self.owned_inequalities]

    @property
    def owned_sites(self) -> Mask:
        """Mask of the sites of friction that this rank owns."""
        return self.friction.owned(self.layout.owned)

    @property
    def owned_tied(self) -> int:
        """Number of tied rows that this rank owns; they come first."""
        return int(np.searchsorted(self.rows.where(Kind.TIED), self.layout.owned))


def build_constraints(
    system: TornSystem, weights: Vector | None = None
) -> tuple[Constraints, Vector]:
    """Build B and c from global node numbers.

    Weights (torn nodes of this rank,) of the copies, subdomain by subdomain, are positive; 1 by
    default. Raises an InputError on all ranks for contradictory prescribed displacements, a
    constraint on a node of no subdomain, a contact or tied row that prescribed displacements
    violate, and rows that exclude each other.
    """
    copies = Copies.build(system, weights)
    directory = Directory(system.comm, copies.nodes)
    table = NodeTable.build(system, directory, copies)
    # most nodes are inside a subdomain and free
    glued = copies.of_nodes(directory.lookup(copies.nodes, table.rows)[1] > 0)
    local = table.lookup(directory, glued.nodes)
    equality = equality_rows(directory, glued, local, system.gdim, system.comm.rank)
    equality_total = first_of_rank(system.comm, int(table.rows.sum()))[1]
    conditions = condition_rows(system, directory, copies, table, equality_total)

    given, has_row = conditions.given, conditions.has_row
    entries = Entries.concatenate([equality.entries, conditions.entries])
    known = given.chosen(has_row).concatenate(conditions.local)
    layout = _along_subdomains(system.comm, equality.entries, known.number)
    shape = layout.numbers.size, sum(subdomain.size for subdomain in system.subdomains)
    matrix = sp.csr_matrix((entries.values, (layout.local(entries.rows), entries.columns)), shape)
    c = np.zeros(layout.numbers.size)
    c[layout.local(equality.prescribed)] = equality.values
    c[layout.local(known.number)] = np.append(conditions.rhs[has_row], conditions.local_rhs)
    position, first = np.unique(layout.local(known.number), return_index=True)
    rows = replace(known.chosen(first), number=position)

    own_rows = np.full(has_row.size, -1, dtype=np.int64)
    own_rows[has_row] = layout.local(given.number[has_row])
    scale, ends = (
        np.where(has_row, given.scale, 1.0),
        np.cumsum([system.contacts.size, system.tied.size]),
    )
    contacts, tied = (
        GivenRows(own_rows[own], conditions.share[own], scale[own])
        for own in (slice(0, ends[0]), slice(ends[0], ends[1]))
    )
    friction = FrictionRows.build(rows, system.gdim - 1, conditions.sites, system.comm)
    constraints = Constraints(
        matrix,
        layout,
        rows,
        contacts,
        tied,
        weights=np.repeat(copies.weight, system.gdim),
        nodes=first_of_rank(system.comm, directory.keys.size)[1],
        redundant=conditions.redundancy.dropped,
        infinite_gaps=conditions.infinite_gaps,
        coupling=_coupling(layout, conditions),
        friction=_with_bounds(friction, system, conditions, contacts, rows, layout),
    )
    return constraints, c


def _with_bounds(
    friction: FrictionRows,
    system: TornSystem,
    conditions: ConditionRows,
    contacts: GivenRows,
    rows: RowTable,
    layout: DualLayout,
) -> FrictionRows:
    """Return the rows with the slip bounds and coefficients of the system. Collective."""
    row = system.friction.row
    pressing = np.isin(contacts.own_rows, rows.where(Kind.CONTACT))
    normal = np.where(pressing, contacts.own_rows, -1)[row]
    scale = np.where(normal >= 0, contacts.scale[row], 0.0)
    coefficient = np.asarray(system.friction.coefficient) * contacts.share[row] * scale
    return friction.with_bounds(
        normal, conditions.leads, system.friction.bound, coefficient, layout
    )


def _along_subdomains(comm: MPI.Intracomm, equality: Entries, conditions: Numbers) -> DualLayout:
    """Lay out the equality rows by their first torn unknowns, then the others by their numbers.

    Products with B and B' then read vectors in sequence, not at random. Collective.
    """
    by_row = np.argsort(equality.rows, kind="stable")
    numbers, starts = np.unique(equality.rows[by_row], return_index=True)
    first = np.minimum.reduceat(equality.columns[by_row], starts) if starts.size else starts
    conditions = np.unique(conditions)
    end = 1 + equality.columns.max(initial=0)
    place = np.concatenate([first, end + np.arange(conditions.size)])
    return DualLayout(comm, np.concatenate([numbers, conditions]), place)


def _coupling(layout: DualLayout, conditions: ConditionRows) -> Coupling:
    """Find the coupled rows' numbers and those that this rank holds. Collective."""
    given, coupled = conditions.given, conditions.redundancy.coupled
    numbers, kind, tolerance = (
        concatenate_ranks(layout.comm, column[coupled])
        for column in (given.number, given.kind, conditions.tolerance)
    )
    positions = np.flatnonzero(np.isin(numbers, layout.numbers))
    rows = layout.local(numbers[positions])
    owned = rows < layout.owned
    return Coupling(
        numbers,
        conditions.redundancy.gram,
        conditions.redundancy.rigid,
        kind,
        tolerance,
        rows,
        positions,
        owned,
        layout.comm,
    )
