"""Areas that belong to the nodes of a surface, with the weight of the measure."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.contact.surfaces.measure_weight import check_weighted_areas
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, area_of_facets
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING


def node_areas(
    boundary: MeshBoundary,
    slave: Surface,
    covered: NDArray[np.bool_],
    name: str,
) -> NDArray[np.float64]:
    """Return each node's area on covered facets, or all of it where it has none. Collective.

    The areas are (k,) [m^2 or m], times the weight of the measure; `covered` (f,) are the facets of
    this rank that count.
    """
    comm, area = boundary.space.mesh.comm, slave.area
    if boundary.weight is not None:
        area = area_of_facets(boundary, slave, np.ones_like(covered), weighted=True)
        check_weighted_areas(comm, area, slave.area, slave.points, f"slave of {name}")
    if comm.allreduce(bool(covered.all()), MPI.LAND):
        return area
    covered_area = area_of_facets(boundary, slave, covered, weighted=True)
    return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)
