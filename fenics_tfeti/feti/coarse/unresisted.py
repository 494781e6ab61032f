"""Loads that no constraint balances: the motion they do work on, and the error that names it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import UnresistedMotion
from fenics_tfeti.feti.coarse.body_motions import describe_body_motions
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.resistance import sum_sparse
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.typing import Vector


def check_load(system: TornSystem, projector: Projector, e: Vector) -> None:
    """Check that the load does no work on the motions that no constraint resists.

    The projector is that of all constraints and e = R'f (coarse,). Raises `UnresistedMotion`, which
    names body and motion. Collective.
    """
    coarse_space = projector.coarse_space
    for group in split_by_groups(system, coarse_space, projector.free_bodies, e):
        if group.counts(group.work):
            raise_unresisted(system, coarse_space, group.motions @ group.work)


@dataclass(frozen=True)
class LoadedGroup:
    """Bodies that contacts connect, and their motions that some rows do not resist."""

    motions: sp.csc_matrix  # orthonormal z (modes * bodies, k), see `BodyMotions`
    work: Vector  # (k,): of the load on these motions [N]
    force: float  # sum of |nodal loads| [N]: bounds the work, but for rotations of what reaches far

    def counts(self, work: Vector) -> bool:
        """Tell whether work on motions is more than rounding [N]."""
        return bool(np.linalg.norm(work) > ZERO * self.force)


def split_by_groups(
    system: TornSystem, coarse_space: CoarseSpace, free: sp.csr_matrix, e: Vector
) -> list[LoadedGroup]:
    """Split unresisted motions by groups of bodies, each with a scale of forces of its own.

    Collective.
    """
    if not free.shape[1]:
        return []
    comm, bodies = system.comm, coarse_space.bodies
    modes, number = bodies.modes, len(bodies.supports)
    force = np.zeros(number)
    for subdomain in system.subdomains:
        nodal = np.linalg.norm(subdomain.size_of_load.reshape(-1, system.gdim), axis=1)
        force[subdomain.body] += nodal.sum()
    force = comm.allreduce(force)
    of_body = sp.kron(sp.identity(number), np.ones((modes, 1)), format="csr")
    moved = abs(bodies.moved) @ of_body
    group = connected_components(sum_sparse(comm, moved.T @ moved), directed=False)[1]
    # bodies that move together are connected by the rows that hold them together
    columns = free.tocsc()
    group_of_motion = group[columns.indices[columns.indptr[:-1]] // modes]
    work = bodies.basis.T @ e
    found = []
    for g in np.unique(group_of_motion):
        motions = columns[:, np.flatnonzero(group_of_motion == g)]
        found.append(LoadedGroup(motions, motions.T @ work, float(force[group == g].sum())))
    return found


def raise_unresisted(
    system: TornSystem,
    coarse_space: CoarseSpace,
    z: Vector,
    factor: float = np.inf,
    friction: str = "",
) -> None:
    """Raise the error for a load that does work on the motion z of bodies. Collective.

    `friction`, what limits it, times `factor` would balance the load.
    """
    own_motion = sp.csr_matrix(coarse_space.own_part(coarse_space.coarse_motions(z)))
    (motions,) = describe_body_motions(system, coarse_space.kernels, own_motion)
    if np.isfinite(factor):
        raise UnresistedMotion(
            f"friction cannot hold the load, which slides {motions}. It would take {factor:.4g} "
            f"times the {friction}. Raise them, prescribe displacements that hold the body, or "
            "reduce the load"
        )
    raise UnresistedMotion(
        "the load does work on a rigid motion that no support and no contact resists (11.16): "
        f"{motions}. Prescribe displacements that hold the body, add the contact it should rest "
        "on, or balance the load"
    )
