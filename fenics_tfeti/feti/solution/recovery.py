"""From multipliers to displacements: the torn one of (11.29), and the one that is returned.

The torn displacement u_t = K^+(f - B'lambda) + R alpha is in equilibrium with the multipliers, but
copies of a node differ a little, and contacts gape or penetrate. The displacement u that is
returned is the nearest one, in the norm of D, on which all constraints hold: glued, with the
prescribed values, closed where contact forces press, without penetration, and without slip where
friction is below its bound; stiff springs are closed by C lambda. The energy of the difference
bounds the error of u (see `certificate`), provided that lambda_I >= o and that the multipliers
balance the load on all rigid motions, G lambda = e.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.constraints.coupling import Coupling
from fenics_tfeti.feti.constraints.face import Face
from fenics_tfeti.feti.constraints.rows import Constraints
from fenics_tfeti.feti.constraints.springs import Springs, pushing_rows
from fenics_tfeti.feti.dual.loose_bodies import LooseBodies, least_penetration
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.feti.tolerances import FEW, MANY, ZERO, rounding
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.qp import balls
from fenics_tfeti.typing import Mask, Vector

# limit on the corrections of forces that turn
_TURNS = 8


@dataclass(frozen=True)
class Recovered:
    """Displacements recovered from multipliers."""

    strained: Vector  # (n,) P_R K^+(f - B'lambda): u_t without its rigid motions [m]
    torn: Vector  # (n,) u_t [m]
    displacement: Vector  # (n,) u: copies of a node are equal, no contact is penetrated [m]
    jumps: Vector  # (m,) Bu - c
    closed: Mask  # (i,) contact rows with a force or a spring, and those that u_t penetrates
    face: Face  # of the multipliers: the slip of its sites that stick is zero


def balance_multipliers(
    coarse_space: CoarseSpace,
    e: Vector,
    multipliers: Vector,
    radius: Vector,
    springs: Springs | None = None,
) -> tuple[Vector, Projector]:
    """Return the feasible multipliers with G lambda = e, and the projector of their face.

    What is missing of G lambda = e is added in the least squares sense on the equality rows, on the
    contact rows with a force or a spring that may pull, and on the tangential rows with a force
    below its bound; forces at their bound turn. Other contact rows whose force would become
    negative leave the face, and sites of friction that would exceed their bound. The given
    multipliers are feasible; they are returned where no face can take what is missing.
    """
    rows = pushing_rows(coarse_space.constraints, springs)
    space = coarse_space.constraints.layout.space
    friction, balanced, turns = coarse_space.constraints.friction, multipliers, 0
    limits = friction.multiplier_set(rows[:0], np.zeros_like(multipliers), radius)
    while True:
        face = Face.of_multipliers(coarse_space.constraints, balanced, radius, springs=springs)
        projector = Projector.build(coarse_space, face.with_turning_forces())
        corrected = _with_missing_forces(projector, e, balanced, radius)
        negative, limited = corrected[rows] < 0.0, limits.project(corrected.copy())
        sliding = face.sticking & ~balls.inside(friction.at_sites(limited), radius)
        if space.sums(float(np.count_nonzero(negative) + np.count_nonzero(sliding)))[0]:
            balanced = balanced.copy()
            balanced[rows[negative]] = 0.0
            slipping = friction.on_rows(sliding, balanced.size)
            balanced[slipping] = limited[slipping]
        elif not friction.curved or turns == _TURNS or _is_balanced(projector, e, corrected):
            return corrected, projector
        else:
            # Newton's method for forces that turn on circles
            balanced, turns = corrected, turns + 1


def _with_missing_forces(
    projector: Projector, e: Vector, multipliers: Vector, radius: Vector
) -> Vector:
    """Return the multipliers with what is missing of G lambda = e; sites that slip at the bound."""
    coarse_space = projector.coarse_space
    friction = coarse_space.constraints.friction
    # the second time for what rounding leaves where contact rows resist much less than others
    for _ in range(2):
        missing = e - coarse_space.restrict(multipliers)
        multipliers = multipliers + projector.least_norm(missing)
        slips = ~projector.face.sticking
        forces = balls.on_boundary(friction.at_sites(multipliers), radius, slips)
        multipliers = friction.with_sites(multipliers, forces)
    return multipliers


def _is_balanced(projector: Projector, e: Vector, multipliers: Vector) -> bool:
    """Tell whether G lambda = e up to rounding, but for free motions."""
    missing = projector.without_free_motions(e - projector.coarse_space.restrict(multipliers))
    return bool(np.linalg.norm(missing) <= rounding(float(np.linalg.norm(e)), MANY))


def recover_displacement(
    F: DualOperator,
    projector: Projector,
    load: Vector,
    c: Vector,
    multipliers: Vector,
    unit: float,
    removed: Vector | None = None,
) -> Recovered:
    """Return u_t of (11.29), and the nearest displacement on which the constraints hold.

    alpha makes the equality rows and the rows with a force, those of the face, hold in the least
    squares sense (end of sec. 11.6). Where these leave motions free, it is the one of smallest norm
    that penetrates nothing, together with motions (coarse,) that were removed from c. A weight of 1
    stands for the stiffness `unit` [N/m].
    """
    coarse_space, rows = projector.coarse_space, F.constraints.inequality
    face, closed_by = projector.face, projector.face.closed_by_springs(multipliers)
    strained = _strained(F, coarse_space, load, multipliers)
    alpha = _motions(F, projector, c + closed_by, strained, multipliers, removed)
    torn = _moved(coarse_space, strained, alpha)
    displacement, closed = close_constraints(F, c, torn, face, multipliers, unit)
    jumps = F.jumps(displacement) - c
    return Recovered(strained, torn, displacement, jumps, (closed | face.rows)[rows], face)


# of large problems a few torn vectors are most of the memory: none is kept beside its successor


def _strained(
    F: DualOperator, coarse_space: CoarseSpace, load: Vector, multipliers: Vector
) -> Vector:
    """Return K^+(f - B'lambda) without rigid motions.

    What rounding leaves in the kernel of K would become a displacement, and the choice of K^+ would
    show in its motions.
    """
    forces = F.constraint_forces(multipliers)
    np.subtract(load, forces, out=forces)
    forces = coarse_space.without_rigid_motion(forces)
    strained = F.generalized_inverse(forces)
    del forces
    return coarse_space.without_rigid_motion(strained)


def _moved(coarse_space: CoarseSpace, strained: Vector, alpha: Vector) -> Vector:
    """Return a displacement with the rigid motions R alpha added."""
    moved = coarse_space.rigid_motion(alpha)
    moved += strained
    return moved


def _motions(
    F: DualOperator,
    projector: Projector,
    c: Vector,
    strained: Vector,
    multipliers: Vector,
    removed: Vector | None,
) -> Vector:
    """Return alpha for a torn displacement without rigid motions: in each of its three parts."""
    coarse_space = projector.coarse_space
    alpha = projector.coefficients(c - F.jumps(strained))
    # once more for what rounding has left
    alpha += projector.coefficients(c - F.jumps(_moved(coarse_space, strained, alpha)))
    loose = LooseBodies.of(coarse_space, projector.face, projector.free_bodies)
    if loose is not None:
        if removed is not None:
            alpha += projector.without_free_motions(removed) - removed
        gap = c - F.jumps(_moved(coarse_space, strained, alpha))
        alpha += _free_motions(projector, loose, gap, multipliers)
    return alpha


def forces_at_rest(
    F: DualOperator, load: Vector, c: Vector, springs: Springs | None = None
) -> Vector | None:
    """Return multipliers with which u = o is the solution: B'lambda = f, and all rows hold.

    That is so for a load on held nodes only, or for one that copies of a node share out; then there
    is no displacement that errors could be compared with. None, on all ranks alike, if something
    moves.
    """
    constraints, coupling = F.constraints, F.constraints.coupling
    # as B_E D^{-1} B_E' = blockdiag(I, W_EE)
    forces = np.where(constraints.equality, F.jumps(load / constraints.weights), 0.0)
    if coupling.tied.any():
        of_tied = coupling.inverse(coupling.tied).solve(coupling.gather(forces)[0])
        forces[coupling.rows] = of_tied[coupling.positions]
    left = np.abs(load - F.constraint_forces(forces))
    largest = largest_of_ranks(constraints.layout.comm, np.abs(load))
    rest = (
        not c[constraints.equality].any()
        and not c[constraints.friction.flat].any()
        and bool((c[constraints.inequality] >= 0.0).all())
        and (springs is None or not c[constraints.inequality][springs.pulling].any())
        and bool((left <= rounding(largest, FEW)).all())
    )
    return forces if constraints.layout.comm.allreduce(rest, MPI.LAND) else None


def close_constraints(
    F: DualOperator, c: Vector, torn: Vector, face: Face, multipliers: Vector, unit: float
) -> tuple[Vector, Mask]:
    """Return the nearest displacement on which the constraints hold, and the rows closed for that.

    u = u_t - D^{-1} B_R' W_R^{-1} (B_R u_t - c_R), with R the rows of the face (equality rows,
    contact rows with a force, tangential rows that stick) and the contact rows that u_t penetrates.
    Springs that are stiffer than a node are closed by C lambda, what softer ones lack to that costs
    less; those that give way where they press are not penetrated. B_R D^{-1} B_R' = W_R is the
    identity but for contact, tied and tangential rows that share a node. Where friction is at its
    bound the part of the slip is removed that is not along the force, if that takes less energy
    than friction loses by it, 2 (r |s| - l_T's); of rows that share a node all of the slip, on the
    same condition. A weight of 1 stands for the stiffness `unit` [N/m].
    """
    constraints, rows = F.constraints, F.constraints.inequality
    jump = F.jumps(torn) - c
    closed, rigid = face.rows.copy(), np.ones(rows.size, dtype=bool)
    if face.springs is not None:
        closed &= unit * face.closed_by_springs(np.ones(closed.size)) <= 1.0
        jump = jump - np.where(closed, face.closed_by_springs(multipliers), 0.0)
        rigid = face.springs.pressed == 0.0
    closed[rows] |= rigid & (jump[rows] > 0.0)
    correction = np.where(closed, jump, 0.0)
    friction = constraints.friction
    slip, costly = _wrong_slips(constraints, jump, multipliers, unit)
    slip[friction.within(face.rows)] = 0.0
    wrong = friction.present & slip.any(axis=1)[:, None]
    correction[friction.rows[wrong]] = slip[wrong]
    # of a coupled row only all of its slip can be taken back
    closed |= friction.on_rows(slip.any(axis=1) & ~costly, closed.size)
    _close_coupled_rows(constraints, jump, correction, closed, rigid)
    u: Vector = F.constraint_forces(correction)
    u /= constraints.weights
    np.subtract(torn, u, out=u)
    return u, closed


def _wrong_slips(
    constraints: Constraints, jump: Vector, multipliers: Vector, unit: float
) -> tuple[Vector, Mask]:
    """Return the parts of slips not along the forces, and where all of the slip costs too much.

    Parts whose removal takes more energy than friction loses by them are left out.
    """
    friction = constraints.friction
    slip, force = friction.at_sites(jump), friction.at_sites(multipliers)
    along, radius = balls.directions(force), np.linalg.norm(force, axis=1)
    unused = 2.0 * radius * balls.misalignment(slip, along)
    costly = unit * np.sum(slip**2, axis=1) >= unused
    forwards = np.sum(slip * along, axis=1)
    slip -= np.maximum(forwards, 0.0)[:, None] * along
    slip[unit * np.sum(slip**2, axis=1) >= unused] = 0.0
    return slip, costly


def _close_coupled_rows(
    constraints: Constraints, jump: Vector, correction: Vector, closed: Mask, rigid: Mask
) -> None:
    """Replace the correction of the coupled rows by W_R^{-1} (B_R u_t - c_R), in place.

    Rows that closing others would penetrate are added to R, of contact rows (i,) the rigid ones.
    Every rank computes all coupled rows.
    """
    coupling = constraints.coupling
    if not coupling.numbers.size:
        return
    resisting = np.zeros(jump.size)
    resisting[constraints.inequality] = rigid
    jumps, on_rows, resisting = coupling.gather(jump, closed.astype(float), resisting)
    y, R = close_with_gram(coupling, jumps, on_rows > 0.0, resisting > 0.0)
    correction[coupling.rows] = y[coupling.positions]
    closed[coupling.rows] = R[coupling.positions]


def close_with_gram(
    coupling: Coupling, jump: Vector, closed: Mask, rigid: Mask
) -> tuple[Vector, Mask]:
    """Return y = W_R^+ jump_R, zero outside R, and R, with W y >= jump on rigid rows outside it.

    W = B D^{-1} B' of the w coupled rows; the jump B u_t - c is positive where penetrated. R starts
    from the closed and the tied rows.
    """
    W, R, block = coupling.gram, closed | coupling.tied, coupling.block
    # of what is closed, in each block of W: gaps of other rows may be far
    negligible = np.zeros(block.max() + 1)
    np.maximum.at(negligible, block, np.where(R, np.abs(jump), np.maximum(jump, 0.0)))
    while True:
        y = coupling.inverse(R).solve(jump)
        penetrated = rigid & ~R & (jump - W @ y > rounding(negligible[block], FEW))
        if not penetrated.any():
            return y, R
        R = R | penetrated


def _free_motions(
    projector: Projector, loose: LooseBodies, gap: Vector, multipliers: Vector
) -> Vector:
    """Return the part of alpha in the free motions, which the other conditions leave.

    They penetrate nothing, and sites whose friction is at its bound slip along it: if these forces
    are in equilibrium, the position of the body follows from the slips alone.
    """
    coarse_space, T = projector.coarse_space, loose.motions
    z = loose.motion(gap)
    if coarse_space.constraints.friction.anywhere:
        backwards, slips = _slips_against_friction(projector, -gap, multipliers)
        against = (backwards @ (T @ z) - slips).max(initial=0.0)
        sizes = np.array([against, np.abs(slips).max(initial=0.0)])
        coarse_space.comm.Allreduce(MPI.IN_PLACE, sizes, MPI.MAX)
        if sizes[0] > ZERO * sizes[1]:
            S = sp.vstack([loose.closing, backwards], format="csr")
            left = np.append(gap[loose.rows], slips) - S @ (T @ z)
            z = z + least_penetration(coarse_space, S, left, T)
    return coarse_space.coarse_motions(T @ z)


def _slips_against_friction(
    projector: Projector, jump: Vector, multipliers: Vector
) -> tuple[sp.csr_matrix, Vector]:
    """Return slip against the force by motions of bodies, and slip along it, where sites may slip.

    They are those of the sites that this rank owns, in units of jumps.
    """
    constraints = projector.coarse_space.constraints
    friction = constraints.friction
    along = balls.directions(friction.at_sites(multipliers))
    slipping = constraints.owned_sites & ~projector.face.sticking
    sites = np.flatnonzero(slipping & along.any(axis=1))
    rows = friction.combined(along, jump.size)[sites] @ sp.diags(constraints.lengths_of_rows())
    slips = np.sum(friction.at_sites(jump)[sites] * along[sites], axis=1)
    return (-(rows @ projector.coarse_space.bodies.moved)).tocsr(), slips
