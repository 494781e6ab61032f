"""Comparison of two surface meshes: matching ones have conditions between pairs of nodes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.contact.surfaces.gathered import GatheredSurface
from fenics_tfeti.fem.contact.surfaces.oriented import tangential_part
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.tolerances import SAME_PLACE
from fenics_tfeti.typing import Vector


def meshes_match(
    slave: Surface,
    master: GatheredSurface,
    normals: Vector,
    tolerance: float,
) -> bool:
    """Tell whether every facet of the slave has one of the master with the same nodes. Collective.

    Nodes are the same if they are opposite each other, along the normal of either surface or their
    mean, up to the rounding of coordinates in single precision. Gaps do not matter, as long as the
    distance along the slave's surface, relative to the size of its facets, is in the tolerance. The
    master is what is near this rank's slave nodes.
    """
    comm = slave.boundary.nodes.comm
    distance, tangential = np.zeros((2, 0))
    partner = np.zeros(0, dtype=np.int64)
    if slave.nodes.size:
        partner = cKDTree(master.points).query(slave.points)[1]
        offset = master.points[partner] - slave.points
        opposite = slave.normal - normals[partner]
        length = np.linalg.norm(opposite, axis=1, keepdims=True)
        opposite = opposite / np.where(length > 0.0, length, 1.0)
        distances = [
            np.linalg.norm(tangential_part(offset, normal), axis=1)
            for normal in (slave.normal, normals[partner], opposite)
        ]
        tangential, distance = distances[0], np.min(distances, axis=0)
    near = (distance <= SAME_PLACE * slave.size) & (tangential <= tolerance * slave.size)
    if not comm.allreduce(bool(near.all()), MPI.LAND):
        return False
    slave_facets = np.sort(slave.at_corners(partner), axis=1)
    facets = np.concatenate([np.sort(master.surface.corners, axis=1), slave_facets])
    number = np.unique(facets, axis=0, return_inverse=True)[1].ravel()
    matching = np.isin(number[len(master.facets) :], number[: len(master.facets)])
    return bool(comm.allreduce(bool(matching.all()), MPI.LAND))
