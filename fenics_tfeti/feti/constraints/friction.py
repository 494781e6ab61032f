"""Tangential rows: the slip of contact rows with friction, and the set of tangential forces.

A contact row with friction has gdim - 1 tangential rows T u - slip, on the same nodes and with the
same weights as the contact row. Both of a node have the same scale t, so that the disc of forces
|t lambda_T| <= Psi is a disc |lambda_T| <= r = Psi / t of multipliers. A direction in which
prescribed displacements decide the slip has no row; the set of the other one is an interval.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.constraints.dual_layout import DualLayout
from fenics_tfeti.feti.constraints.row_table import Kind, RowTable
from fenics_tfeti.feti.system import ContactRows
from fenics_tfeti.feti.tolerances import MANY, rounding
from fenics_tfeti.parallel import largest_of_ranks, positions
from fenics_tfeti.qp import Bounds, Discs, ProductSet, balls
from fenics_tfeti.typing import Mask, Numbers, Vector

# the bound of springs along the surface [N], which no force reaches
_UNLIMITED = 1e100


@dataclass(frozen=True)
class SlipBound:
    """The law of friction |lambda_T| <= r + m lambda_N, at the sites of a rank."""

    radius: Vector  # (k,): r
    slope: Vector  # (k,): m

    def at(self, pressing: Vector) -> Vector:
        """Return the bound (k,) at normal multipliers lambda_N."""
        return self.radius + self.slope * pressing

    def limited(self, radius: Vector) -> Vector:
        """Return bounds (k,), zero for springs that have none: sizes of forces of friction."""
        return np.where(self.radius < np.sqrt(_UNLIMITED), radius, 0.0)


@dataclass(frozen=True)
class FrictionRows:
    """The tangential rows that this rank holds, by sites; it holds all rows of a site.

    Directions without a row have the position -1; the positions of the first direction that has one
    ascend. Several contacts may be at one site: `own`, `normal` and `own_bound` are of the contact
    rows with friction that this rank gave.
    """

    rows: Numbers  # (k, gdim - 1): local positions
    contact: Numbers  # (k,): number of the contact, of the first one
    scale: Vector  # (k,): t: a jump divided by t is a slip [m], t lambda_T a force [N]
    own: Numbers  # (g,): position of the site; -1 where it has no rows
    anywhere: bool  # whether any rank has a site
    curved: bool  # whether any rank has a site with two rows, and so a disc
    normal: Numbers  # (g,): local position of its contact row; -1 where it is no row of B
    # as given: r = Psi / t, m = Coulomb's coefficient * factor of the contact row / t; the sums
    # over the contacts of a site, and those of each
    bound: SlipBound
    own_bound: SlipBound

    @staticmethod
    def build(
        table: RowTable, directions: int, own_sites: Numbers, comm: MPI.Intracomm
    ) -> FrictionRows:
        """Collect the rows of each site, without bounds. Collective.

        The table is of the rows that this rank holds. `own_sites` (g,) are the sites of the contact
        rows that this rank gave.
        """
        tangents = table.of(Kind.TANGENT)
        sites, first, at = np.unique(tangents.site, return_index=True, return_inverse=True)
        rows = np.full((sites.size, directions), -1, dtype=np.int64)
        rows[at.ravel(), tangents.direction] = tangents.number
        order = np.argsort(first)
        position = np.full(sites.size + 1, -1, dtype=np.int64)
        position[order] = np.arange(sites.size)
        first = first[order]
        none = np.zeros(own_sites.size)
        has_sites = np.array([sites.size > 0, directions == 2 and (rows >= 0).all(axis=1).any()])
        comm.Allreduce(MPI.IN_PLACE, has_sites, MPI.LOR)
        return FrictionRows(
            rows[order],
            tangents.contact[first],
            tangents.scale[first],
            position[positions(sites, own_sites)],
            bool(has_sites[0]),
            bool(has_sites[1]),
            np.full(own_sites.size, -1, dtype=np.int64),
            SlipBound(np.zeros(sites.size), np.zeros(sites.size)),
            SlipBound(none, none),
        )

    def with_bounds(
        self, normal: Numbers, leads: Mask, bound: Vector, coefficient: Vector, layout: DualLayout
    ) -> FrictionRows:
        """Return the rows with slip bounds and coefficients. Collective.

        All arrays (g,) are of the contact rows with friction that this rank gave: their local
        positions, or -1, which are the first of their sites, their bounds [N], and their
        coefficients times the factors of their normal multipliers.
        """
        scale = self.given(self.scale)
        parts = (
            np.divide(x, scale, out=np.zeros_like(scale), where=scale > 0.0)
            for x in (np.minimum(bound, _UNLIMITED), np.where(normal >= 0, coefficient, 0.0))
        )
        own_bound = SlipBound(*parts)
        sums = SlipBound(*(self.from_given(x, layout) for x in vars(own_bound).values()))
        return replace(self, normal=np.where(leads, normal, -1), bound=sums, own_bound=own_bound)

    @property
    def size(self) -> int:
        """Number of sites that this rank holds."""
        return int(self.scale.size)

    @cached_property
    def present(self) -> Mask:
        """Which directions of each site have a row, (k, gdim - 1)."""
        return self.rows >= 0

    @cached_property
    def flat(self) -> Numbers:
        """The local positions of all rows."""
        return self.rows[self.present]

    def owned(self, owned: int) -> Mask:
        """Tell which sites this rank owns, of a layout with so many owned rows."""
        return self.rows.max(axis=1, initial=-1) < owned

    def at_sites(self, x: Vector) -> Vector:
        """Return a vector (m,) at the sites, (k, gdim - 1), zero in directions without a row."""
        return np.where(self.present, x[self.rows], 0.0)

    def with_sites(self, x: Vector, at_sites: Vector) -> Vector:
        """Return a vector (m,) with other values at the sites, (k, gdim - 1)."""
        x = x.copy()
        x[self.flat] = at_sites[self.present]
        return x

    def from_given(self, values: Vector, layout: DualLayout) -> Vector:
        """Return the sums (k,) at all sites of values (g,) that each rank gave. Collective."""
        part, at = np.zeros(layout.numbers.size), self.rows.max(axis=1, initial=-1)
        here = self.own >= 0
        np.add.at(part, at[self.own[here]], values[here])
        return layout.sum(part)[at]

    def pressing(self, multipliers: Vector, layout: DualLayout) -> Vector:
        """Return lambda_N >= 0 at the sites, (k,); 0 without a contact row. Collective.

        Forces that are rounding of the largest one count as none: bounds of an unloaded contact
        made of them would be the scale of its certificate.
        """
        none = rounding(largest_of_ranks(layout.comm, np.abs(multipliers)), MANY)
        forces = np.where(multipliers > none, multipliers, 0.0)
        with_none = np.append(forces, 0.0)
        return self.from_given(with_none[self.normal], layout)

    def numbers(self, layout: DualLayout) -> Vector:
        """Return a number for each site, (k,), the same on all ranks."""
        return layout.numbers[self.rows.max(axis=1, initial=-1)].astype(np.float64)

    def normal_numbers(self, layout: DualLayout) -> Numbers:
        """Return the global numbers of the sites' contact rows, (k,); -1 for none. Collective."""
        numbers = np.append(layout.numbers, -1)[self.normal]
        return self.from_given(numbers + 1.0, layout).astype(np.int64) - 1

    def given(self, at_sites: Vector) -> Vector:
        """Return values at sites (k, ...) for those that this rank gave, in its order."""
        with_none = np.concatenate([at_sites, np.zeros((1, *at_sites.shape[1:]))])
        return with_none[self.own]

    def spread(self, at_sites: Vector, size: int) -> Vector:
        """Return values at sites, (k,) or (k, gdim - 1), on their rows, (m,), zero on others."""
        at_sites = at_sites if at_sites.ndim == 2 else at_sites[:, None]
        return self.with_sites(np.zeros(size), np.broadcast_to(at_sites, self.rows.shape))

    def on_rows(self, sites: Mask, size: int) -> Mask:
        """Return the mask (m,) of the rows of some sites (k,)."""
        mask = np.zeros(size, dtype=bool)
        mask[self.rows[self.present & sites[:, None]]] = True
        return mask

    def combined(self, vectors: Vector, size: int) -> sp.csr_matrix:
        """Return the combinations (k, m) of the rows of each site with coefficients (k, d)."""
        sites = np.broadcast_to(np.arange(self.size)[:, None], self.rows.shape)[self.present]
        entries = vectors[self.present], (sites, self.flat)
        return sp.csr_matrix(entries, (self.size, size))

    def at_bound(self, multipliers: Vector, radius: Vector) -> Vector:
        """Return the multipliers with forces that are at the bound up to rounding exactly there."""
        forces = self.at_sites(multipliers)
        at_bound = balls.on_boundary(forces, radius, ~balls.inside(forces, radius))
        return self.with_sites(multipliers, at_bound)

    def within(self, rows: Mask) -> Mask:
        """Tell of which sites the rows are in a mask (m,)."""
        return (rows[self.rows] & self.present).any(axis=1)

    def moved(self, places: Numbers) -> FrictionRows:
        """Return the rows at new local positions, by the old ones."""
        rows = np.where(self.present, places[self.rows], -1)
        return replace(self, rows=rows, normal=np.append(places, -1)[self.normal])

    def multiplier_set(self, pushing: Numbers, shift: Vector, radius: Vector) -> ProductSet:
        """Return {x : shift + x is feasible}, with lambda_I >= o and |lambda_T| <= r.

        `pushing` (i,) are the local positions of the rows that do not pull, ascending, `shift`
        (m,) is lambda~, and `radius` (k,) is r of each site.
        """
        below = np.full(shift.size, -np.inf)
        above = np.full(shift.size, np.inf)
        below[pushing] = -shift[pushing]
        several = self.present.all(axis=1) & (self.rows.shape[1] == 2)
        alone = self.present & ~several[:, None]
        rows, half = self.rows[alone], np.broadcast_to(radius[:, None], alone.shape)[alone]
        below[rows], above[rows] = -half - shift[rows], half - shift[rows]
        bounds, at = Bounds.from_vector(below, above), self.rows[several]
        return ProductSet(bounds, Discs(at, -shift[at], radius[several]) if self.curved else None)


def check_slides(
    contacts: ContactRows, direction: Numbers, gap: Vector, tolerance: Vector, free: Mask
) -> None:
    """Check that prescribed displacements slide nothing that may slip in another direction.

    The conditions (r,) are all of this rank; the tangential rows of a site follow each other. `gap`
    is the right-hand side without the part that prescribed displacements decide, `tolerance` its
    rounding, `free` tells whether a row has a free part. Raises an InputError on this rank that
    names the first slave node.
    """
    first, second = np.flatnonzero(direction == 0), np.flatnonzero(direction == 1)
    if not second.size:
        return
    decided = np.where(free[first], second, first)
    sliding = (free[first] != free[second]) & (np.abs(gap[decided]) > tolerance[decided])
    if sliding.any():
        k = decided[np.flatnonzero(sliding)[0]]
        raise InputError(
            f"friction: prescribed displacements slide {np.count_nonzero(sliding)} contact rows in "
            f"one tangential direction and leave the other free, the first by {-gap[k]:g} at "
            f"slave node {contacts.slave[k]}. Prescribe both directions, or take friction out"
        )


def common_scale(scale: Vector, direction: Numbers, kept: Mask) -> Vector:
    """Return factors that are the same for both tangential rows of a site, up to the last bit.

    The longer row has length 1. Where displacements are prescribed at some nodes of a site, the
    other one is shorter.
    """
    second = np.flatnonzero(kept & (direction == 1))
    second = second[kept[second - 1]]
    scale = scale.copy()
    scale[second] = scale[second - 1] = np.minimum(scale[second], scale[second - 1])
    return scale
