"""Transfer of the contact from another mesh, as a guess of forces and gaps on this one.

Pressures and the approach of the surfaces to each other depend little on the mesh. They are
interpolated on the facets of the other mesh's slave surfaces; forces and gaps follow with the areas
and the initial gaps of this mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.conditions.contact_conditions import ContactConditions
from fenics_tfeti.fem.contact.solution.results import ContactResult
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti.system import ContactGuess
from fenics_tfeti.parallel import concatenate_ranks
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class SolvedContact:
    """The solution on the whole of a slave's surface, on every rank."""

    surface: SurfaceFacets
    # (n, 3): 1, the force over undeformed area [Pa] and (u_slave - u_master)'n [m]; 0 at nodes
    # without condition
    values: Vector


def gather_solved(
    all_conditions: Sequence[ContactConditions],
    results: Sequence[ContactResult],
    displacement: Function,
) -> list[SolvedContact]:
    """Gather the solution on the slaves' surfaces on every rank. Collective."""
    solved = []
    for conditions, result in zip(all_conditions, results, strict=True):
        nodes, slave = conditions.surface.boundary.nodes, conditions.surface.gathered()
        relative = conditions.relative(nodes.values(displacement))
        approach = np.sum(relative * conditions.normal, axis=1)
        # not the pressure that is reported, which is a mean at the rim
        force = result.nodal_normal_force / conditions.area * conditions.stretch
        columns = np.column_stack([np.ones_like(approach), force, approach])
        conditioned, columns = (
            concatenate_ranks(nodes.comm, column) for column in (conditions.slave, columns)
        )
        values = np.zeros((slave.nodes.size, 3))
        values[np.searchsorted(slave.nodes, conditioned)] = columns
        solved.append(SolvedContact(slave, slave.from_corners(values)))
    return solved


def expected_contact(
    solved: Sequence[SolvedContact], all_conditions: Sequence[ContactConditions]
) -> ContactGuess:
    """Transfer forces and gaps to this rank's conditions of the same contacts on another mesh."""
    forces, gaps = [np.zeros(0)], [np.zeros(0)]
    for coarse, conditions in zip(solved, all_conditions, strict=True):
        points = conditions.coordinates[:, : conditions.normal.shape[1]]
        # the weight is the interpolated share of paired nodes; far from all there is no force
        weight, pressure, approach = coarse.surface.interpolate(coarse.values, points).T
        near = weight > RELATIVE_ROUNDING
        weight = np.where(near, weight, 1.0)
        forces.append(np.where(near, pressure / weight * conditions.area / conditions.stretch, 0.0))
        gaps.append(np.where(near, conditions.gap - approach / weight, np.inf))
    return ContactGuess(np.concatenate(forces), np.concatenate(gaps))
