"""Areas that belong to the nodes of a surface, with the weight of the measure."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from fenics_tfeti.fem.contact.surfaces.measure_weight import check_weighted_areas
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Mask, Vector


def node_areas(slave: Surface, covered: Mask, name: str) -> Vector:
    """Return each node's area on covered facets, or all of it where it has none. Collective.

    The areas are (k,) [m^2 or m], times the weight of the measure; `covered` (f,) are the facets of
    this rank that count.
    """
    comm, area, weight = slave.boundary.nodes.comm, slave.area, slave.boundary.nodal_weight()
    if weight is not None:
        area = slave.share_of_area(np.ones_like(covered), weight)
        check_weighted_areas(comm, area, slave.area, slave.points, f"slave of {name}")
    if comm.allreduce(bool(covered.all()), MPI.LAND):
        return area
    covered_area = slave.share_of_area(covered, weight)
    return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)
