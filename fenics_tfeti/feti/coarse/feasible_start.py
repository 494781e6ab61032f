"""A start with G lambda = e (11.37) and lambda_I >= o: lemma 11.1, also in the semicoercive case.

Gluing and supports resist all but a few rigid motions of bodies; forces of contact must balance the
load on those. They are those of rigid bodies with elastic surfaces, which are also the first active
set: between rigid rings the load is shared by as many rollers. The equality multipliers then follow
from (11.38). In the coercive case there are no such motions, the contact forces are zero, and the
start is that of lemma 11.1.

Friction takes part within its bounds. Whether contact and friction together can balance the load is
decided here.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.coarse.unresisted import LoadedGroup, raise_unresisted, split_by_groups
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.friction import SlipBound
from fenics_tfeti.feti.constraints.springs import Springs
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import SURFACE, ZERO
from fenics_tfeti.parallel import concatenate_ranks, first_of_rank
from fenics_tfeti.qp import Bounds, FrictionCones, ProductSet, least_norm, smallest_factor
from fenics_tfeti.typing import Numbers, Vector

# motions of a group up to which dense matrices take no longer than sparse ones
_DENSE = 200


def feasible_start(
    system: TornSystem,
    coarse_space: CoarseSpace,
    e: Vector,
    c: Vector,
    unit: float,
    bound: SlipBound,
    *,
    springs: Springs | None = None,
    close_gaps: bool,
    explain: bool = True,
) -> Vector:
    """Return lambda~ with G lambda~ = e, lambda~_I >= o and |lambda~_T| <= r + m lambda~_N.

    Bodies are rigid and contact rows are springs of a part of the stiffness `unit` [N/m], with
    friction of any stiffness; equality rows that resist motions weakly, as soft springs do, are
    springs too. Contact rows with springs that may pull hold bodies as equality rows do. With
    close_gaps, for the first active set and the first bounds of Coulomb's law, gaps have to be
    closed before contact presses also where no soft support resists; SMALBE-M, which adds to these
    forces, takes fewer products from the smallest ones. Raises `UnresistedMotion` if no admissible
    forces balance the load e = R'f (11.16); `explain` adds, at a cost, how much friction it would
    take. Collective.
    """
    constraints = coarse_space.constraints
    supports = Projector.build(coarse_space, Face.supports(constraints, springs))
    start = np.zeros(constraints.size)
    # soft supports would be stretched far by what contact can carry
    resistance = coarse_space.resistance_of_supports(springs)
    if resistance.values.size:
        free, soft = resistance.free, resistance.resisted
        prescribed = coarse_space.prolong(supports.coefficients(c))
        gaps = unit * (c - prescribed)[constraints.inequality]
        if close_gaps:
            gaps *= SURFACE
        elif not soft.shape[1]:
            gaps = np.where(np.isfinite(gaps), 0.0, gaps)
        some = coarse_space.comm.allreduce(int(np.count_nonzero(bound.radius + bound.slope)))
        # with friction, soft supports carry what contact and friction need not
        motions = free if some else sp.hstack([free, soft], format="csc")
        for group in split_by_groups(system, coarse_space, motions, e):
            if not group.counts(group.work):
                continue
            if some:
                start += _forces_with_friction(system, coarse_space, group, gaps, bound, explain)
            else:
                start += _contact_forces(system, coarse_space, group, free, gaps)
    # (11.38) for what the contact forces leave
    return start + supports.least_norm(e - coarse_space.restrict(start))


def _contact_forces(
    system: TornSystem,
    coarse_space: CoarseSpace,
    group: LoadedGroup,
    free: sp.csr_matrix,
    gaps: Vector,
) -> Vector:
    """Return the contact multipliers that balance the load on a group of rigid bodies.

    Contact rows are springs, and equality rows where they resist the motions weakly; `gaps`, times
    stiffness, have to be closed before contacts press. Of motions `free` of equality rows contact
    has to take the whole load.
    """
    constraints = coarse_space.constraints
    multipliers = np.zeros(constraints.size)
    # the ranks' columns side by side: as many as contact rows, not as unknowns
    owned = constraints.owned_contact_rows
    moved, gaps = _moved_rows(coarse_space, group.motions)[owned], gaps[: owned.size]
    # rows of other groups, and those that cannot close, take no part
    apart = ~np.isfinite(gaps) | (np.diff(moved.indptr) == 0)
    moved, gaps = sp.diags((~apart).astype(float)) @ moved, np.where(apart, 0.0, gaps)
    contact, first = _side_by_side(coarse_space.comm, moved)
    weakly = _weak_columns(coarse_space, group.motions)
    if len(group.work) <= _DENSE or weakly.shape[1]:
        contact = contact.toarray()
    forces, residual = least_norm(
        contact,
        group.work,
        springs=weakly if weakly.shape[1] else None,
        gap=concatenate_ranks(coarse_space.comm, gaps),
    )
    unresisted = free @ (free.T @ (group.motions @ residual))
    if group.counts(unresisted):
        raise_unresisted(system, coarse_space, unresisted)
    multipliers[owned] = forces[first : first + owned.size]
    return constraints.layout.sum(multipliers)


def _side_by_side(comm: MPI.Intracomm, rows: sp.csr_matrix) -> tuple[sp.csc_matrix, int]:
    """Return the ranks' rows as columns side by side, and the number of this rank's first."""
    first, size = first_of_rank(comm, rows.shape[0])
    coo = rows.tocoo()
    shifted = sp.coo_matrix((coo.data, (coo.col, coo.row + first)), (rows.shape[1], size))
    return sum_sparse(comm, shifted).tocsc(), first


def _forces_with_friction(
    system: TornSystem,
    coarse_space: CoarseSpace,
    group: LoadedGroup,
    gaps: Vector,
    bound: SlipBound,
    explain: bool,
) -> Vector:
    """Return the multipliers of contact and friction that balance the load on a group.

    They have the least norm, with `gaps`, times stiffness, as linear costs of the contact forces:
    open contacts press only where others and friction cannot hold the load. The equality rows do
    not resist the motions of the group.
    """
    constraints, comm = coarse_space.constraints, coarse_space.comm
    multipliers, friction = np.zeros(constraints.size), constraints.friction
    moved_rows = _moved_rows(coarse_space, group.motions)
    owned = constraints.owned_contact_rows
    gaps = gaps[: owned.size]
    closing = np.isfinite(gaps)
    pressing, first = _side_by_side(comm, sp.diags(closing.astype(float)) @ moved_rows[owned])
    owned_sites = constraints.owned_sites
    present = friction.present[owned_sites]
    # a direction without a row is a column of zeros
    rubbing, first_rubbing = _side_by_side(
        comm,
        sp.diags(present.ravel().astype(float)) @ moved_rows[friction.rows[owned_sites].ravel()],
    )
    layout = constraints.layout
    number, radius, slope, normal = (
        concatenate_ranks(comm, part)
        for part in (
            layout.numbers[owned],
            bound.radius[owned_sites],
            bound.slope[owned_sites],
            friction.normal_numbers(layout)[owned_sites],
        )
    )
    feasible, columns = _contact_and_friction(number, normal, radius, slope, present.shape[1])
    nothing = sp.csr_matrix((group.work.size, columns - pressing.shape[1] - rubbing.shape[1]))
    C = sp.hstack([pressing, rubbing, nothing], format="csr")
    C = C.toarray() if group.work.size <= _DENSE else C
    gap = np.zeros(columns)
    gap[: pressing.shape[1]] = concatenate_ranks(comm, np.where(closing, gaps, 0.0))
    forces, residual = least_norm(C, group.work, feasible, gap=gap)
    if group.counts(residual):
        some = explain and (radius.any() or slope.any())
        factor = smallest_factor(C, group.work, feasible) if some else np.inf
        kinds = ["slip bounds"] * bool(radius.any()) + ["coefficients of friction"] * bool(
            slope.any()
        )
        motion = group.motions @ residual
        raise_unresisted(system, coarse_space, motion, factor, " and ".join(kinds))
    multipliers[owned] = forces[first : first + owned.size]
    first = pressing.shape[1] + first_rubbing
    of_sites = forces[first : first + present.size].reshape(present.shape)
    multipliers[friction.rows[owned_sites][present]] = of_sites[present]
    return constraints.layout.sum(multipliers)


def _contact_and_friction(
    number: Numbers, normal: Numbers, radius: Vector, slope: Vector, directions: int
) -> tuple[ProductSet, int]:
    """Return the set of contact forces, after them those of friction, and their number.

    A site whose bound does not depend on a normal force (normal is -1) has a force of its own,
    which does nothing. The numbers are global ones of contact rows: (c,) of all, (k,) of the sites,
    with r and m (k,) and `directions` tangential components of each.
    """
    contact, k = number.size, radius.size
    tangential = contact + np.arange(directions * k).reshape(k, directions)
    at = contact + directions * k + np.arange(k)
    order = np.argsort(number)
    found = np.searchsorted(number[order], normal)
    pressed = np.flatnonzero((slope > 0.0) & np.isin(normal, number))
    at[pressed] = order[found[pressed]]
    below = np.setdiff1d(np.arange(contact), at[pressed])
    slope = np.where(at < contact, slope, 0.0)
    cones = FrictionCones(np.column_stack([at, tangential]), radius, slope)
    bounds = Bounds.from_below(below, np.zeros(below.size))
    return ProductSet(bounds, cones=cones), contact + (directions + 1) * k


def _moved_rows(coarse_space: CoarseSpace, motions: sp.csc_matrix) -> sp.csr_matrix:
    """Return B R T z without what rounding leaves where parts of a motion cancel."""
    bodies, lengths = coarse_space.bodies, coarse_space.constraints.lengths_of_rows()
    moved = (bodies.moved @ motions).tocsr()
    moved.data[np.abs(moved.data) <= bodies.rounding] = 0.0
    moved.eliminate_zeros()
    return (sp.diags(lengths) @ moved).tocsr()


def _weak_columns(coarse_space: CoarseSpace, motions: sp.csc_matrix) -> Vector:
    """Return what equality rows do to the motions: as few columns as there are motions."""
    constraints = coarse_space.constraints
    moved = _moved_rows(coarse_space, motions)
    owned = np.flatnonzero(constraints.equality[: constraints.layout.owned])
    moving = owned[np.diff(moved.indptr)[owned] > 0]
    rows = np.linalg.qr(moved[moving].toarray(), mode="r")
    whole = np.concatenate(coarse_space.comm.allgather(rows))
    columns = np.transpose(np.linalg.qr(whole, mode="r"))
    return columns[:, np.abs(columns).max(axis=0, initial=0.0) > ZERO]
