"""Areas that belong to the nodes of a surface, with the weight of the measure."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.measure_weight import as_ufl_weight, check_weighted_areas
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.topology import vertex_nodes
from fenics_tfeti.parallel import raise_collectively
from fenics_tfeti.typing import Mask, Vector


def nodal_weight(boundary: MeshBoundary, weight: Any, name: str) -> Vector | None:
    """Evaluate the weight of ds at all local nodes at vertices; None without one. Collective."""
    space = boundary.space
    with raise_collectively(space.mesh.comm):
        ufl_weight = as_ufl_weight(space.mesh, weight, name)
    if ufl_weight is None:
        return None
    scalar = Function(_compat.lagrange_space(space.mesh, 1))
    _compat.interpolate_expression(ufl_weight, scalar)
    scalar.x.scatter_forward()
    values = np.zeros(boundary.nodes.size)
    # the two spaces may number their nodes differently
    values[vertex_nodes(space)] = scalar.x.array[vertex_nodes(scalar.function_space)]
    return values


def node_areas(slave: Surface, covered: Mask, weight: Vector | None, name: str) -> Vector:
    """Return each node's area on covered facets, or all of it where it has none. Collective.

    The areas are (k,) [m^2 or m], times the weight (nodes,); `covered` (f,) are the facets of this
    rank that count.
    """
    comm, area = slave.boundary.nodes.comm, slave.area
    if weight is not None:
        area = slave.share_of_area(np.ones_like(covered), weight)
        check_weighted_areas(comm, area, slave.area, slave.points, f"slave of {name}")
    if comm.allreduce(bool(covered.all()), MPI.LAND):
        return area
    covered_area = slave.share_of_area(covered, weight)
    return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)
