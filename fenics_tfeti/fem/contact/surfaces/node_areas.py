"""Areas that belong to the nodes of a surface, with the weight of the measure."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.measure_weight import as_ufl_weight, check_weighted_areas
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, area_of_facets
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import raise_collectively


def weighted_form(boundary: MeshBoundary, weight: Any, name: str) -> _compat.CompiledForm | None:
    """Return the form of a contact's areas with a weight of ds; None without one. Collective."""
    domain = boundary.space.mesh
    with raise_collectively(domain.comm):
        ufl_weight = as_ufl_weight(domain, weight, name)
    return None if ufl_weight is None else boundary.form_with_weight(ufl_weight)


def node_areas(
    boundary: MeshBoundary,
    slave: Surface,
    covered: NDArray[np.bool_],
    form: _compat.CompiledForm | None,
    name: str,
) -> NDArray[np.float64]:
    """Return each node's area on covered facets, or all of it where it has none. Collective.

    The areas are (k,) [m^2 or m], times the weight of the form; `covered` (f,) are the facets of
    this rank that count.
    """
    comm, area = boundary.space.mesh.comm, slave.area
    if form is not None:
        area = area_of_facets(boundary, slave, np.ones_like(covered), form)
        check_weighted_areas(comm, area, slave.area, slave.points, f"slave of {name}")
    if comm.allreduce(bool(covered.all()), MPI.LAND):
        return area
    covered_area = area_of_facets(boundary, slave, covered, form)
    return np.where(covered_area > RELATIVE_ROUNDING * area, covered_area, area)
