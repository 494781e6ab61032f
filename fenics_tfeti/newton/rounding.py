"""Rounding of coordinates: distances and forces of its size are no motion and no force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import COORDINATE_ROUNDING
from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.parallel import largest_of_ranks
from fenics_tfeti.typing import Vector

# of strains, which are differences of displacements and not of coordinates, relative to one
_STRAIN = 1e-14


@dataclass(frozen=True)
class Rounding:
    """Lengths and forces of rounding, at the nodes that this rank owns.

    Displacements are added to coordinates, and deformation gradients to one. Relative to the
    displacements alone, a body at rest has errors of any size.
    """

    extent: float  # largest coordinate of the mesh [m]
    strained: Vector  # (owned,): forces of strains of one [N]
    stiffness: Vector  # (owned,): forces of displacements of one [N/m]

    @staticmethod
    def of(subdomains: Sequence[Subdomain], nodes: NodeMap) -> Rounding:
        """Measure the stiffness of subdomains. Collective."""
        at = np.concatenate([np.zeros(0, dtype=np.int64), *(s.nodes for s in subdomains)])
        sizes = np.concatenate([np.zeros((0, 2)), *(_forces_of_one(s) for s in subdomains)])
        strained, stiffness = nodes.reduce_at_owners(at, sizes, np.maximum).T
        extent = largest_of_ranks(nodes.comm, np.abs(nodes.coordinates))
        return Rounding(extent, strained, stiffness)

    @staticmethod
    def none(nodes: NodeMap) -> Rounding:
        """Return zeros: all forces and distances count."""
        return Rounding(0.0, np.zeros(nodes.owned), np.zeros(nodes.owned))

    def length(self, displacement: float) -> float:
        """Return what is left of distances, at a largest displacement [m]."""
        return COORDINATE_ROUNDING * max(self.extent, displacement)

    def internal_forces(self, displacement: float) -> Vector:
        """Return what is left of internal forces (owned,), at a largest displacement [N]."""
        return _STRAIN * (self.strained + self.stiffness * displacement)

    def contact_forces(self, displacement: float) -> Vector:
        """Return what is left of contact forces (owned,), at a largest displacement [N]."""
        return self.stiffness * self.length(displacement)


def _forces_of_one(subdomain: Subdomain) -> Vector:
    """Return the forces (nodes, 2) of strains and of displacements of one, of any directions."""
    x, K = subdomain.coordinates, abs(subdomain.stiffness).tocoo()
    gdim = x.shape[1]
    distance = np.linalg.norm(x[K.row // gdim] - x[K.col // gdim], axis=1)
    sums = [np.bincount(K.row, values, x.size) for values in (K.data * distance, K.data)]
    return np.reshape(sums, (2, -1, gdim)).max(axis=2).T
