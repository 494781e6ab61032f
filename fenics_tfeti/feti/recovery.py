"""From multipliers to displacements: (11.29) with the alpha of the end of sec. 11.6."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.dual.operator import DualOperator
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.qp import least_distance

__all__ = ["glue", "least_distance", "recover_displacement"]

Vector = NDArray[np.float64]


def recover_displacement(
    F: DualOperator, active: Projector, load: Vector, c: Vector, multipliers: Vector
) -> Vector:
    """Return u = K^+(f - B'lambda) + R alpha (11.29).

    alpha makes the equality rows and the active inequality rows hold in the least squares sense;
    where these leave motions free, it is the one of smallest norm that penetrates nothing.

    Parameters
    ----------
    F : DualOperator
        K^+ and B.
    active : Projector
        That of the equality rows and the active inequality rows.
    load : (n,) array
        f of this rank's subdomains [N].
    c : (m,) array
        Right-hand sides of the constraints.
    multipliers : (m,) array
        lambda.

    Returns
    -------
    (n,) array
        u of this rank's subdomains [m].
    """
    coarse_space = active.coarse_space
    forces = load - F.constraint_forces(multipliers)
    # what the stopping test left in the kernel of K; K^+ would turn it into a displacement
    u = F.generalized_inverse(forces - coarse_space.rigid_motion(coarse_space.coarse_load(forces)))

    alpha = active.coefficients(c - F.jumps(u))
    # K^+ leaves some of the free motions in u
    present = alpha + coarse_space.coarse_load(u)
    alpha -= active.free @ (active.free.T @ present)
    u += coarse_space.rigid_motion(alpha)
    if active.free.shape[1]:
        away = _smallest_without_penetration(active, c - F.jumps(u))
        u += coarse_space.rigid_motion(active.free @ away)
    return u


def glue(F: DualOperator, c: Vector, u: Vector) -> Vector:
    """Return the nearest displacement (in the norm of D) on which all equality rows hold.

    That is u - D^{-1} B_E'(B_E u - c_E): the weighted mean of the copies of a node, and the
    prescribed values where there are any.

    Parameters
    ----------
    F : DualOperator
        For B.
    c : (m,) array
        Right-hand sides of the constraints.
    u : (n,) array
        A torn displacement of this rank's subdomains [m].
    """
    jump = np.where(F.constraints.equality, F.jumps(u) - c, 0.0)
    glued: Vector = u - F.constraint_forces(jump) / F.constraints.weights
    return glued


def _smallest_without_penetration(active: Projector, gap: Vector) -> Vector:
    """Return the smallest free motions, in the basis ``active.free``, that penetrate nothing.

    Bodies that nothing presses together may part, but not overlap. Conditions are added as they are
    violated: the worst one of each contact and rank at a time.
    """
    constraints, comm = active.coarse_space.constraints, active.coarse_space.comm
    owned = constraints.inequality[: constraints.owned_inequalities]
    inactive = np.flatnonzero(~active.rows[owned])
    contact = constraints.contact[inactive]
    closing = np.asarray(active.coarse_space.contact[:, inactive].T @ active.free)
    gap = gap[owned[inactive]]
    z = np.zeros(active.free.shape[1])
    conditions, limits = np.zeros((0, z.size)), np.zeros(0)
    negligible = 1e-9 * comm.allreduce(float((-gap).max(initial=0.0)), MPI.MAX)
    for _ in range(100):
        excess = closing @ z - gap
        order = np.lexsort((-excess, contact))
        worst = order[np.unique(contact[order], return_index=True)[1]]
        worst = worst[excess[worst] > negligible]
        new = concatenate_ranks(comm, closing[worst])
        if not len(new):
            break
        conditions = np.concatenate([conditions, new])
        limits = np.concatenate([limits, concatenate_ranks(comm, gap[worst])])
        z = least_distance(conditions, limits)
    return z
