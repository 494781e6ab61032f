"""The bodies that contact and tied rows connect, and their groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.feti.constraints.row_table import Kind
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import Directory, concatenate_buffers, count_over_ranks
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class RowBodies:
    """The bodies that contact and tied rows connect.

    A pair (row, body) stands for each body of an inequality row that this rank holds, whichever
    rank has the body, in ascending order; (site, site_body) for those of sites of friction.
    """

    bodies: int  # number over all ranks
    contacts: int  # number over all ranks
    of_subdomain: Numbers  # (subdomains,) body of each of this rank's subdomains
    ends: Numbers  # (subdomains + 1,) first torn unknown of each of them, and the end of the last
    row: Numbers  # (p,)
    body: Numbers  # (p,)
    tied: Numbers  # (2, q) pairs of bodies that tied and held rows of this rank connect
    site: Numbers  # (s,)
    site_body: Numbers  # (s,)

    @staticmethod
    def build(system: TornSystem, constraints: Constraints, ends: Numbers) -> RowBodies:
        """Find the bodies of contact and tied rows. Collective.

        `ends` (subdomains + 1,) has the first torn unknown of each subdomain, and the end of the
        last.
        """
        of_subdomain = system.bodies
        count = count_over_ranks(system.comm, of_subdomain)
        of_unknowns = partial(_bodies_of_unknowns, of_subdomain, ends)
        of_rows = partial(_bodies_of_rows, constraints, of_unknowns)
        row, body = of_rows(constraints.inequality)
        table = constraints.rows
        joined = np.append(table.where(Kind.TIED), table.where(Kind.HELD))
        pairs = _pairs(*of_rows(joined))
        numbers = table.of(Kind.CONTACT, Kind.TANGENT).contact
        contacts = count_over_ranks(system.comm, numbers)
        sites = of_rows(constraints.friction.rows.max(axis=1))
        return RowBodies(count, contacts, of_subdomain, ends, row, body, pairs, *sites)

    def of_unknowns(self, unknowns: Numbers) -> Numbers:
        """Return the bodies of torn unknowns of this rank."""
        return _bodies_of_unknowns(self.of_subdomain, self.ends, unknowns)

    def groups(self, comm: MPI.Intracomm, closed: Mask, with_force: Mask) -> Numbers:
        """Return the group of each body. Collective.

        Bodies are connected by contact rows (i,) that are closed, by sites of friction (k,) that
        may have a force, and by tied rows.
        """
        rows, sites = closed[self.row], with_force[self.site]
        pairs = np.hstack(
            [
                _pairs(self.row[rows], self.body[rows]),
                _pairs(self.site[sites], self.site_body[sites]),
                self.tied,
            ]
        )
        first, last = concatenate_buffers(comm, *pairs)
        graph = sp.coo_matrix(
            (np.ones(first.size), (first, last)), shape=(self.bodies, self.bodies)
        )
        return connected_components(graph, directed=False)[1].astype(np.int64)

    def largest(self, of_body: Vector, rows: int) -> Vector:
        """Return the largest value among the bodies of each inequality row, of `rows` rows."""
        largest = np.zeros(rows)
        np.maximum.at(largest, self.row, of_body[self.body])
        return largest

    def largest_at_sites(self, of_body: Vector, sites: int) -> Vector:
        """Return the largest value among the bodies of each of `sites` sites of friction."""
        largest = np.zeros(sites)
        np.maximum.at(largest, self.site, of_body[self.site_body])
        return largest

    def of_rows(self, rows: int) -> Numbers:
        """Return one of the bodies of each of `rows` inequality rows."""
        body = np.zeros(rows, dtype=np.int64)
        body[self.row[::-1]] = self.body[::-1]
        return body

    def of_sites(self, sites: int) -> Numbers:
        """Return one of the bodies of each of `sites` sites of friction."""
        body = np.zeros(sites, dtype=np.int64)
        body[self.site[::-1]] = self.site_body[::-1]
        return body


def _bodies_of_unknowns(of_subdomain: Numbers, ends: Numbers, unknowns: Numbers) -> Numbers:
    """Return the bodies of torn unknowns, by those of subdomains."""
    of_unknown: Numbers = of_subdomain[np.searchsorted(ends, unknowns, side="right") - 1]
    return of_unknown


def _bodies_of_rows(
    constraints: Constraints, of_unknowns: Callable[[Numbers], Numbers], rows: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the positions in `rows`, ascending, and the bodies of each, of all ranks."""
    numbers = constraints.layout.numbers[rows]
    entries = constraints.matrix[rows].tocoo()
    own = np.unique(np.stack([numbers[entries.row], of_unknowns(entries.col)]), axis=1)
    directory = Directory(constraints.layout.comm, numbers)
    number, body = np.unique(np.stack(directory.forward(*own)), axis=1)
    order = np.argsort(numbers, kind="stable")
    row = order[np.searchsorted(numbers[order], number)]
    by_row = np.lexsort((body, row))
    return row[by_row], body[by_row]


def _pairs(row: Numbers, body: Numbers) -> Numbers:
    """Return the distinct pairs (2, q) of the first body of a row and each of its bodies."""
    first = body[np.searchsorted(row, row)]
    return np.unique(np.stack([first, body]), axis=1)


def without_unloaded_groups(
    constraints: Constraints,
    row_bodies: RowBodies,
    load: Vector,
    c: Vector,
    multipliers: Vector,
    springs: Springs | None = None,
) -> Vector:
    """Return the multipliers with zeros in groups without a load where that is no worse.

    Bodies that do not press on others decouple, unless springs may pull, and without a load the
    dual function of such a group is at most -1/2 lambda'F lambda - c'lambda. Where c'lambda >= 0,
    as in a body that touches nothing, lambda = o is at least as good. What the iterations leave
    there instead has no scale: relative to the energy of the group, which is all error, it never
    becomes small. G lambda = e remains true. Collective.
    """
    comm, layout = constraints.layout.comm, constraints.layout
    parts = np.split(load, row_bodies.ends[1:-1]) if row_bodies.of_subdomain.size else []
    has_load = np.array([part.any() for part in parts], dtype=bool)
    of_body = np.bincount(row_bodies.of_subdomain[has_load], minlength=row_bodies.bodies)
    loaded = layout.space.sum_over_ranks(of_body.astype(float))
    if loaded.all():
        return multipliers
    with_force = constraints.friction.at_sites(multipliers).any(axis=1)
    connecting = multipliers[constraints.inequality] > 0.0
    if springs is not None:
        connecting |= springs.pulling
    group = row_bodies.groups(comm, connecting, with_force)
    matrix = constraints.matrix
    rows = np.flatnonzero(np.diff(matrix.indptr))
    # all bodies of a row with a force are of one group
    first = matrix.indices[matrix.indptr[rows]]
    row_group = group[row_bodies.of_unknowns(first)]
    size = int(group.max(initial=-1)) + 1
    owned = rows < layout.owned
    works = np.bincount(row_group[owned], (c * multipliers)[rows[owned]], size)
    work = layout.space.sum_over_ranks(works.astype(float))
    unloaded = (np.bincount(group, loaded, size) == 0.0) & (work >= 0.0)
    part = np.zeros(multipliers.size)
    part[rows] = unloaded[row_group]
    return np.where(layout.sum(part) > 0.0, 0.0, multipliers)
