"""Choice of the slave of mortar conditions among two surfaces.

The condition number of the rows is about 1 + E_s h_m / (E_m h_s), with Young's moduli E and sizes h
of the facets of slave and master: the slave should be the surface with the smaller E / h. It is
found from the stiffness matrices: their diagonal entries are about E h^(d - 2) in d dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Vector


def nodal_stiffness(nodes: NodeMap, subdomains: Sequence[Subdomain]) -> Vector:
    """Return the sum of the diagonal entries (owned,) at each node [N/m]. Collective."""
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in subdomains)])
    matrices = {id(s.stiffness): s.stiffness for s in subdomains}
    sums = {
        key: K.diagonal().reshape(-1, nodes.components).sum(axis=1) for key, K in matrices.items()
    }
    diagonals = [sums[id(s.stiffness)] for s in subdomains]
    return nodes.reduce_at_owners(numbers, np.concatenate([np.zeros(0), *diagonals]))


def roles_ratios(
    comm: MPI.Intracomm, all_conditions: Sequence[ContactConditions], stiffness: Vector
) -> list[float | None]:
    """Return E / h of slaves over that of masters, 0 of rigid ones. Collective.

    It is None of pairs of nodes and of surfaces that are not opposite each other.
    """
    sums = np.zeros((len(all_conditions), 2, 3))
    rows = comm.allreduce(np.array([conditions.gap.size for conditions in all_conditions]))
    for row, conditions in enumerate(all_conditions):
        for column, surface in enumerate(conditions.surfaces):
            of_nodes = (stiffness[surface.local].sum(), surface.size.sum(), surface.nodes.size)
            sums[row, column] = of_nodes
    comm.Allreduce(MPI.IN_PLACE, sums)
    ratios: list[float | None] = [None] * len(all_conditions)
    for k, conditions in enumerate(all_conditions):
        if conditions.is_mortar and rows[k]:
            entries, size, nodes = sums[k].T
            # entries / nodes over h^(d - 1); the dimension that divides both cancels
            slave, master = entries / nodes * (size / nodes) ** (1 - conditions.normal.shape[1])
            ratios[k] = float(slave / master) if master > 0.0 else 0.0
    return ratios
