"""Misfit between the deformed state and the contact conditions of a solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from dolfinx.fem import Function

from fenics_tfeti.fem.contact.conditions.deformed import DeformedContact
from fenics_tfeti.fem.contact.solution.results import ContactResult


@dataclass(frozen=True)
class GeometryPass:
    """Misfit between the deformed state and the contact conditions of one solution."""

    penetration: float  # largest depth of a slave node in a master or an obstacle [m]
    # largest distance, along the normal, of a loaded slave node from its master or obstacle [m]
    separation: float
    # largest distance, along the surface, between where mortar conditions let contact forces act on
    # the master and what is opposite in the deformed state, relative to the size of the facets
    slip: float
    # angle between contact forces and the deformed normals, root of the mean square with the forces
    # as weights [rad]: the part of the forces that acts along the surfaces
    tilt: float
    # forces that are not in equilibrium on rigid bodies where these are now, as of contact forces
    # whose arms have changed, relative to the contact forces
    imbalance: float
    # by how much friction forces break their law with the deformed surfaces, see `NewtonStep`
    friction: float
    # largest of these, of penetration and separation relative to the displacement
    error: float
    products: int  # applications of F in the solution
    # wall time, summed over its phases, each the slowest rank's [s]; the first pass has the set-up
    # too
    seconds: float = 0.0


def geometry_pass(
    deformed: Sequence[DeformedContact],
    results: Sequence[ContactResult],
    displacement: Function,
    products: int,
    imbalance: float = 0.0,
    friction: float = 0.0,
) -> GeometryPass:
    """Compare deformed surfaces with the conditions and forces of a solution. Collective."""
    comm = displacement.function_space.mesh.comm
    largest = np.array([0.0, 0.0, 0.0, np.abs(displacement.x.array).max(initial=0.0)])
    sums = np.zeros(2)
    for new, result in zip(deformed, results, strict=True):
        loaded = result.active
        slip = np.zeros(0) if new.slip is None else new.slip[loaded]
        distances = (new.penetration, np.abs(new.distance[loaded]), slip)
        largest[:3] = np.maximum(largest[:3], [part.max(initial=0.0) for part in distances])
        force = result.nodal_normal_force[loaded]
        rotation = np.linalg.norm((new.normal - result.normal)[loaded], axis=1)
        sums += [np.sum(force * rotation**2), np.sum(force)]
    comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
    comm.Allreduce(MPI.IN_PLACE, sums, MPI.SUM)
    tilt = float(np.sqrt(sums[0] / sums[1])) if sums[1] > 0.0 else 0.0
    penetration, separation, slip, size = largest.tolist()
    error = max(penetration, separation) / size if size > 0.0 else 0.0
    measures = slip, tilt, imbalance, friction
    return GeometryPass(penetration, separation, *measures, max(error, *measures), products)
