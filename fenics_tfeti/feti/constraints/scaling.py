"""Weights of the copies of a node: the D in B D^{-1} B' = blockdiag(I, W) (sec. 11.12, scaling).

With weights of stiffness, F = BK^+B' measures K relative to D: a material that is a thousand times
softer than its neighbour does not dominate F. The bounds of the dual problem stay as they are, as
each contact row is multiplied by a positive number and only gluing rows are combined. Of nearly
incompressible materials D is the stiffness of shear: the volume resists few displacements. In the
preconditioner of sec. 11.12, B_D = (B D^{-1} B')^{-1} B D^{-1} is B D^{-1} but for contact and tied
rows that share nodes (`coupling`).

Rigid bodies do not give way: D is practically infinite there, so that B D^{-1} B' is that of the
other nodes of a row. Rows at rigid bodies alone have no part in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fenics_tfeti.feti.local.moduli import compressibility, share_of_shear
from fenics_tfeti.feti.system import TornSystem
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Vector

Scaling = Literal["multiplicity", "stiffness"]

# weight of a copy in a rigid body: its flexibility is less than the rounding of all others
RIGID = float(np.finfo(float).eps) ** -2


@dataclass(frozen=True)
class NodeWeights:
    """Weights of the copies of nodes, and the moduli that they are made of."""

    values: Vector  # (torn nodes of this rank,): positive and at most 1, or RIGID
    unit: float  # the stiffness that a weight of 1 stands for; the mean one for multiplicity [N/m]
    bulk_over_shear: list[float]  # kappa / mu of each subdomain


def node_weights(system: TornSystem, scaling: Scaling) -> NodeWeights:
    """Return a weight for each copy of a node. Collective.

    By "multiplicity" they are 1; by "stiffness" the mean of the diagonal of K_i over the components
    of the node, of shear alone where the volume is much stiffer, relative to the largest over all
    ranks. Those of rigid bodies are `RIGID` in either case.
    """
    ratios = compressibility(system.subdomains)
    stiffness = _diagonals(system, ratios)
    rigid = system.at_copies(np.array([s.is_rigid for s in system.subdomains], dtype=bool))
    of_subdomain = [ratios[id(s.stiffness)] for s in system.subdomains]
    if scaling == "multiplicity":
        total, count = system.comm.allreduce(np.array([stiffness.sum(), (~rigid).sum()]))
        unit, weights = float(total / count), np.ones(stiffness.size)
    else:
        unit = largest_of_ranks(system.comm, stiffness)
        weights = stiffness / unit
    return NodeWeights(np.where(rigid, RIGID, weights), unit, of_subdomain)


def unit_scale(flexibility: Vector) -> Vector:
    """Return factors of rows that make B D^{-1} B' = 1, or 1 for rows at rigid bodies alone.

    The flexibility is B D^{-1} B' of the rows without them.
    """
    rigid = flexibility <= RIGID**-0.75
    return 1.0 / np.sqrt(np.where(rigid, 1.0, flexibility))


def _diagonals(system: TornSystem, ratios: Mapping[int, float]) -> Vector:
    """Return the mean diagonal of K_i at each copy of a node, or the part of it that is shear's."""
    matrices = {id(s.stiffness): s.stiffness for s in system.subdomains}
    mean = {
        key: matrix.diagonal().reshape(-1, system.gdim).mean(axis=1)
        * share_of_shear(ratios[key], system.gdim)
        for key, matrix in matrices.items()
    }
    return np.concatenate([np.zeros(0), *(mean[id(s.stiffness)] for s in system.subdomains)])
