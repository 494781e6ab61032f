"""Areas that belong to the nodes of a surface, with the weight of the measure."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.surfaces.measure_weight import check_weighted_areas, given_weight
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, area_of_facets
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.parallel import raise_collectively


def weighted_form(boundary: MeshBoundary, weight: Any, name: str) -> _compat.CompiledForm | None:
    """Return the form of a contact's areas with a weight of ds; None without one. Collective.

    Parameters
    ----------
    boundary : MeshBoundary
        Of the displacement's mesh.
    weight : UFL expression, number or None
        The contact's `measure_weight`.
    name : str
        Name of the contact.

    Raises
    ------
    InputError
        A weight that is no scalar expression on the mesh.
    """
    domain = boundary.space.mesh
    with raise_collectively(domain.comm):
        given = given_weight(domain, weight, name)
    return None if given is None else boundary.form_with_weight(given)


def node_areas(
    boundary: MeshBoundary,
    slave: Surface,
    covered: NDArray[np.bool_],
    form: _compat.CompiledForm | None,
    name: str,
) -> NDArray[np.float64]:
    """Return the area of each node on covered facets, or all of its area where it has none.

    Collective.

    Parameters
    ----------
    boundary : MeshBoundary
        Of the displacement's mesh.
    slave : Surface
        The surface.
    covered : (f,) bool array
        Which of this rank's facets count.
    form : CompiledForm or None
        The form of the areas with the weight, see `weighted_form`.
    name : str
        Name of the contact.

    Returns
    -------
    (k,) array
        [m^2 or m], times the weight.

    Raises
    ------
    InputError
        A weight that is not positive around some nodes.
    """
    comm, area = boundary.space.mesh.comm, slave.area
    if form is not None:
        area = area_of_facets(boundary, slave, np.ones_like(covered), form)
        check_weighted_areas(comm, area, slave.area, slave.points, f"slave of {name}")
    if comm.allreduce(bool(covered.all()), MPI.LAND):
        return area
    of_covered = area_of_facets(boundary, slave, covered, form)
    return np.where(of_covered > RELATIVE_ROUNDING * area, of_covered, area)
