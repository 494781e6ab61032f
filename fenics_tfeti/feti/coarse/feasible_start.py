"""A start with G lambda = e (11.37) and lambda_I >= o: lemma 11.1, also in the semicoercive case.

Gluing and supports resist all but a few rigid motions of bodies; forces of contact must balance the
load on those. Least-norm contact forces that do are the solution of a small problem; the equality
multipliers then follow from (11.38). In the coercive case there are no such motions, the contact
forces are zero, and the start is that of lemma 11.1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.errors import UnresistedMotion
from fenics_tfeti.feti.coarse.body_motions import describe_body_motion
from fenics_tfeti.feti.coarse.projector import Projector
from fenics_tfeti.feti.coarse.space import CoarseSpace
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.feti.tolerances import NO_WORK
from fenics_tfeti.qp import least_norm_nonnegative

__all__ = ["check_load", "feasible_start", "least_norm_nonnegative"]

Vector = NDArray[np.float64]


def check_load(
    system: TornSystem, kernels: Sequence[Vector], projector: Projector, e: Vector, norm: float
) -> None:
    """Check that the load does no work on the motions that no constraint resists.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    kernels : sequence of arrays
        R_i of this rank's subdomains.
    projector : Projector
        Of all constraints.
    e : (coarse,) array
        R'f.
    norm : float
        ||f||, the scale of e.

    Raises
    ------
    UnresistedMotion
        Naming body and motion.
    """
    work = projector.free.T @ e
    if np.linalg.norm(work) > NO_WORK * norm:
        _raise_unresisted(system, kernels, projector.coarse_space.own_part(projector.free @ work))


def feasible_start(
    system: TornSystem, kernels: Sequence[Vector], coarse_space: CoarseSpace, e: Vector, norm: float
) -> Vector:
    """Return lambda~ with G lambda~ = e and lambda~_I >= o.

    Parameters
    ----------
    system : TornSystem
        The subdomains.
    kernels : sequence of arrays
        R_i of this rank's subdomains.
    coarse_space : CoarseSpace
        G.
    e : (coarse,) array
        R'f.
    norm : float
        ||f||, the scale of e.

    Returns
    -------
    (m,) array
        The multipliers that this rank holds.

    Raises
    ------
    UnresistedMotion
        If no contact forces balance the load (11.16), naming body and motion.
    """
    constraints = coarse_space.constraints
    supports = Projector.build(coarse_space, np.zeros(constraints.inequality.size, dtype=bool))
    start = np.zeros(constraints.size)
    if supports.free.shape[1]:
        start[constraints.inequality] = _contact_forces(
            system, kernels, coarse_space, supports, e, norm
        )
    # (11.38) for what the contact forces leave
    left = e - coarse_space.restrict(start)
    return start + supports.expand(supports.solve(left))


def _contact_forces(
    system: TornSystem,
    kernels: Sequence[Vector],
    coarse_space: CoarseSpace,
    supports: Projector,
    e: Vector,
    norm: float,
) -> Vector:
    """Return least-norm nonnegative multipliers that balance the load on the free motions."""
    constraints = coarse_space.constraints
    # the ranks' columns side by side: as many as contact rows, not as unknowns
    held = (coarse_space.contact.T @ supports.free).T
    owned = constraints.owned_inequalities
    columns = coarse_space.comm.allgather(held[:, :owned])
    first = sum(part.shape[1] for part in columns[: coarse_space.comm.rank])
    C, d = np.concatenate(columns, axis=1), supports.free.T @ e

    if np.linalg.norm(d) <= NO_WORK * norm:
        return np.zeros(constraints.inequality.size)
    forces, residual = least_norm_nonnegative(C, d)
    if np.linalg.norm(residual) > NO_WORK * norm:
        _raise_unresisted(system, kernels, coarse_space.own_part(supports.free @ residual))
    multipliers = np.zeros(constraints.size)
    multipliers[constraints.inequality[:owned]] = forces[first : first + owned]
    shared: Vector = constraints.layout.sum(multipliers)[constraints.inequality]
    return shared


def _raise_unresisted(system: TornSystem, kernels: Sequence[Vector], own_motion: Vector) -> None:
    motions = describe_body_motion(system, kernels, own_motion)
    raise UnresistedMotion(
        "the load does work on a rigid motion that no support and no contact resists (11.16): "
        + "; ".join(motions)
        + ". Prescribe displacements that hold the body, add the contact it should rest on, or "
        "balance the load"
    )
