"""Conditions of contacts (sec. 11.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class MortarTerms:
    """The terms of mortar conditions: sums of displacements with scalar weights.

    There are k conditions and t terms: those of condition i from offsets[i] up to offsets[i + 1],
    first its slave node, then further slave nodes, then master nodes.
    """

    offsets: Numbers  # (k + 1,)
    nodes: Numbers  # global nodes of the displacement's space (t,)
    # (t,): integrals of dual times shape functions, negative on the master [m^2 or m]
    weights: Vector
    slaves: Numbers  # numbers of terms of slave nodes (k,)

    @property
    def row(self) -> Numbers:
        """The condition of each term, (t,)."""
        return np.repeat(np.arange(self.slaves.size), np.diff(self.offsets))

    @property
    def area(self) -> Vector:
        """The sum of the slave's weights of each condition, (k,)."""
        position = np.arange(self.nodes.size) - self.offsets[:-1][self.row]
        weights = np.where(position < self.slaves[self.row], self.weights, 0.0)
        area = np.zeros(self.slaves.size)
        np.add.at(area, self.row, weights)
        return area


@dataclass(frozen=True)
class ContactPairing:
    """The k slave nodes that this rank owns and that have a contact condition.

    The gap is (chi(x) - x)'n (11.7), of a mortar condition the mean with its dual function. The
    area belongs to the node: in a partial contact that of the facets whose nodes all have partners,
    where the node has such facets; of a mortar condition the integral of its dual function over the
    covered part. It has the weight of the measure.
    """

    name: str
    slave: Numbers  # global nodes of the displacement's space (k,)
    master: Numbers  # (k,): partners, or the masters with the largest weights; -1 for an obstacle
    coordinates: Vector  # slave nodes (k, 3) [m]
    normal: Vector  # outward unit normals of the slave (k, gdim)
    gap: Vector  # (k,) [m]; infinite where there is no obstacle
    area: Vector  # (k,) [m^2 or m]
    summary: dict[str, Any]  # the contact's entry of `Report.pairing`
    surface: Surface  # all of the slave's surface
    covered: NDArray[np.bool_]  # (f,): whether the surface's facets have partners at all nodes
    terms: MortarTerms | None = None  # None for pairs of nodes, and for degree 1 at obstacles
    coverage: Vector | None = None  # (k,), see `ContactResult`; 1 by default
    # (s, gdim): components prescribed at the surface's nodes, for mortar conditions
    prescribed: NDArray[np.bool_] | None = None
    master_surface: Surface | None = None  # for mortar conditions
