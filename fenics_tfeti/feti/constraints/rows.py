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
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import Directory, concatenate_ranks, first_of_rank
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class SurfaceRows:
    """The contact rows, or the tied rows, that this rank holds.

    Of the rows given, those that are far away, that prescribed displacements or tied rows decide
    and that are farther away than a parallel one are no rows of B. Equal ones are one row.
    """

    rows: Numbers  # (k,): local positions, ascending
    contact: Numbers  # (k,): number of the contact, of the first one
    scale: Vector  # (k,): t
    own_rows: Numbers  # (rows that this rank gave,): local positions; -1 for no row of B
    share: Vector  # (rows that this rank gave,): part of the row's force, with a sign

    def forces(self, multipliers: Vector) -> Vector:
        """Return the force of each row that this rank gave [N]; 0 if it is no row of B.

        It acts on the slave against the row's normal.
        """
        # -1 is the last one, zero; a rank may give rows without holding a single row of B
        force = np.zeros(multipliers.size + 1)
        force[self.rows] = self.scale * multipliers[self.rows]
        return self.share * force[self.own_rows]

    def moved(self, places: Numbers) -> SurfaceRows:
        """Return the rows at new local positions, by the old ones."""
        own_rows = np.append(places, -1)[self.own_rows]
        return replace(self, rows=places[self.rows], own_rows=own_rows)


@dataclass(frozen=True)
class Constraints:
    """B of Bu <= c (inequality rows) and Bu = c (equality rows), on this rank's torn unknowns.

    Friction has rows of its own, whose jumps Bu - c are slips. A contact row is t times the
    condition whose slave's sum has length 1: its jump divided by t is a distance [m], and t lambda
    is the normal force [N].
    """

    matrix: sp.csr_matrix  # (m, n): columns of this rank's subdomains, all rows with an entry there
    layout: DualLayout  # global numbers of the rows, and the ranks that share them
    contacts: SurfaceRows  # the inequality rows
    held: SurfaceRows  # contact rows that hold with equality
    tied: SurfaceRows  # equality rows
    weights: Vector  # (n,): diagonal of D for this rank's torn displacements
    nodes: int  # distinct nodes over all ranks
    redundant: int  # contact and tied rows that others imply or equal
    infinite_gaps: int  # contact rows dropped because their gap is infinite
    coupling: Coupling  # contact, tied and tangential rows that are not orthogonal to all others
    friction: FrictionRows

    @property
    def inequality(self) -> Numbers:
        """Local positions (i,) of the inequality rows, ascending."""
        return self.contacts.rows

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
        mask[self.inequality] = False
        mask[self.friction.flat] = False
        return mask

    def normal_forces(self, multipliers: Vector) -> Vector:
        """Return the normal force of each contact row that this rank gave [N]."""
        return self.contacts.forces(multipliers) + self.held.forces(multipliers)

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
            (self.contacts.own_rows, other.contacts.own_rows),
            (self.held.own_rows, other.held.own_rows),
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
            and np.array_equal(self.contacts.contact, other.contacts.contact)
            and np.array_equal(self.held.contact, other.held.contact)
            and np.array_equal(self.tied.contact, other.tied.contact)
            and np.array_equal(self.friction.contact, other.friction.contact)
            and np.array_equal(self.contacts.share, other.contacts.share)
            and np.array_equal(self.held.share, other.held.share)
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
        return int(np.searchsorted(self.tied.rows, self.layout.owned))


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
    rows = given.chosen(has_row).concatenate(conditions.local)
    layout = _along_subdomains(system.comm, equality.entries, rows.number)
    shape = layout.numbers.size, sum(subdomain.size for subdomain in system.subdomains)
    matrix = sp.csr_matrix((entries.values, (layout.local(entries.rows), entries.columns)), shape)
    c = np.zeros(layout.numbers.size)
    c[layout.local(equality.prescribed)] = equality.values
    c[layout.local(rows.number)] = rows.rhs

    own_rows = np.full(has_row.size, -1, dtype=np.int64)
    own_rows[has_row] = layout.local(given.number[has_row])
    # each row once
    position, first = np.unique(layout.local(rows.number), return_index=True)
    rows = rows.chosen(first)
    slip = rows.tangential.mask
    first_rows = np.arange(has_row.size) < system.contacts.size
    contacts, held, tied = (
        SurfaceRows(
            position[chosen],
            rows.contact[chosen],
            rows.scale[chosen],
            np.where(of_kind, own_rows, -1)[own],
            conditions.share[own],
        )
        for chosen, of_kind, own in (
            (~(rows.tied | rows.held | slip), ~given.held, first_rows),
            (rows.held, given.held, first_rows),
            (rows.tied, given.tied, given.tied),
        )
    )
    friction = FrictionRows.build(
        position[slip],
        rows.tangential.chosen(slip),
        rows.contact[slip],
        rows.scale[slip],
        system.gdim - 1,
        conditions.sites,
        system.comm,
    )
    constraints = Constraints(
        matrix,
        layout,
        contacts,
        held,
        tied,
        weights=np.repeat(copies.weight, system.gdim),
        nodes=first_of_rank(system.comm, directory.keys.size)[1],
        redundant=conditions.redundancy.dropped,
        infinite_gaps=conditions.infinite_gaps,
        coupling=_coupling(layout, conditions),
        friction=_with_bounds(friction, system, conditions, contacts, layout),
    )
    return constraints, c


def _with_bounds(
    friction: FrictionRows,
    system: TornSystem,
    conditions: ConditionRows,
    contacts: SurfaceRows,
    layout: DualLayout,
) -> FrictionRows:
    """Return the rows with the slip bounds and coefficients of the system. Collective."""
    row = system.friction.row
    scale = np.zeros(layout.numbers.size + 1)
    scale[contacts.rows] = contacts.scale
    normal = contacts.own_rows[row]
    coefficient = np.asarray(system.friction.coefficient) * contacts.share[row] * scale[normal]
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
    numbers, tied, tangential, tolerance = (
        concatenate_ranks(layout.comm, column[coupled])
        for column in (given.number, given.tied, given.tangential.mask, conditions.tolerance)
    )
    positions = np.flatnonzero(np.isin(numbers, layout.numbers))
    rows = layout.local(numbers[positions])
    owned = rows < layout.owned
    return Coupling(
        numbers,
        conditions.redundancy.gram,
        conditions.redundancy.rigid,
        tied,
        tangential,
        tolerance,
        rows,
        positions,
        owned,
        layout.comm,
    )
