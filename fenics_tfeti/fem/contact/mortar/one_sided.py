"""Conditions of displacements of degree 2 at a rigid obstacle: means around the slave's vertices.

A uniform pressure on a quadratic triangle gives no force at its vertices: conditions node by node
would not balance it. As between two surfaces, the multipliers are therefore those of dual functions
at the vertices, and the gap is integrated with them; the master's part is missing.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.contact import Terms
from fenics_tfeti.fem.contact.mortar.conditions import SlaveFacets, collect_terms
from fenics_tfeti.fem.contact.mortar.facets import Facets
from fenics_tfeti.fem.contact.mortar.integrals import integrate_alone
from fenics_tfeti.fem.contact.mortar.matrices import slave_matrix
from fenics_tfeti.parallel import Directory
from fenics_tfeti.typing import Mask, Numbers, Vector


def one_sided_conditions(
    comm: MPI.Intracomm, slave: SlaveFacets, owned: Numbers, chosen: Mask
) -> tuple[Numbers, Terms]:
    """Integrate over chosen facets of the slave, and sum up at the owners of its nodes. Collective.

    The facets (f,) chosen are those that have an obstacle, `owned` the slave's nodes of this rank,
    ascending. Returned are the slave nodes (k,) that have a condition, ascending, and the terms.
    """
    facets = Facets(slave.facets.points, slave.facets.nodes[chosen])
    weight = None if slave.weight is None else slave.weight[chosen]
    D = slave_matrix(integrate_alone(facets, weight), facets).tocoo()
    owners = Directory(comm, owned)
    row, column = slave.nodes[D.row], slave.nodes[D.col]
    return collect_terms(owners, row, column, D.data, np.ones(D.nnz, dtype=bool))


def nodal_normals(slave: SlaveFacets) -> Vector:
    """Return unit normals (n, gdim) at all of the facets' nodes, between vertices their mean."""
    facets, v = slave.facets, slave.facets.number_of_corners
    normal = np.zeros_like(facets.points)
    normal[facets.corners] = slave.normals
    ends = range(v if v > 2 else 1)
    middles = [0.5 * (slave.normals[:, k] + slave.normals[:, (k + 1) % v]) for k in ends]
    for k, middle in enumerate([*middles, slave.normals.mean(axis=1)], start=v):
        if k < facets.nodes.shape[1]:
            normal[facets.nodes[:, k]] = middle
    units: Vector = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return units
