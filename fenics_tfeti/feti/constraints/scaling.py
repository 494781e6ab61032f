"""Weights of the copies of a node: the D in B D^{-1} B' = blockdiag(I, W) (sec. 11.12, scaling).

With weights of stiffness, F = BK^+B' measures K relative to D: a material that is a thousand times
softer than its neighbour does not dominate F. The bounds of the dual problem stay as they are, as
each contact row is multiplied by a positive number and only gluing rows are combined. In the
preconditioner of sec. 11.12, B_D = (B D^{-1} B')^{-1} B D^{-1} is B D^{-1} but for contact and tied
rows that share nodes (`coupling`).
"""

from __future__ import annotations

from typing import Literal

from mpi4py import MPI

import numpy as np

from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.typing import Vector

Scaling = Literal["multiplicity", "stiffness"]


def node_weights(system: TornSystem, scaling: Scaling) -> Vector:
    """Return a weight for each copy of a node.

    By "multiplicity" they are 1; by "stiffness" the mean of the diagonal of K_i over the components
    of the node, relative to the largest over all ranks. Returns (torn nodes of this rank,),
    positive and at most 1.
    """
    if scaling == "multiplicity":
        return np.ones(sum(subdomain.nodes.size for subdomain in system.subdomains))
    stiffness = _diagonals(system)
    weights: Vector = stiffness / _largest(system, stiffness)
    return weights


def stiffness_of_weight(system: TornSystem, scaling: Scaling) -> float:
    """Return the stiffness that a weight of 1 stands for [N/m]; the mean one for multiplicity."""
    stiffness = _diagonals(system)
    if scaling == "stiffness":
        return _largest(system, stiffness)
    total, count = system.comm.allreduce(np.array([stiffness.sum(), stiffness.size]))
    return float(total / count)


def _diagonals(system: TornSystem) -> Vector:
    """Return the mean diagonal of K_i at each copy of a node."""
    matrices = {id(s.stiffness): s.stiffness for s in system.subdomains}
    mean = {
        key: matrix.diagonal().reshape(-1, system.gdim).mean(axis=1)
        for key, matrix in matrices.items()
    }
    return np.concatenate([np.zeros(0), *(mean[id(s.stiffness)] for s in system.subdomains)])


def _largest(system: TornSystem, stiffness: Vector) -> float:
    return float(system.comm.allreduce(float(stiffness.max(initial=0.0)), MPI.MAX))
