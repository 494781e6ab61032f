"""Bulk and shear modulus of a subdomain, from the energies of linear displacements."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti.system import Subdomain
from fenics_tfeti.typing import Vector

# ratio of bulk and shear modulus from which on the volumetric part of K counts by itself: Poisson's
# ratio 0.45
NEARLY_INCOMPRESSIBLE = 10.0


def bulk_over_shear(stiffness: sp.csr_matrix, coordinates: Vector) -> float:
    """Return kappa / mu of a stiffness matrix (n, n), coordinates (nodes, gdim) [m].

    It is exact for a uniform isotropic material, else a mean. The shear modulus is that of the
    softest shear: in axisymmetry others stretch the circumference. It is 1 where more
    than half of the bulk modulus may be that of springs of the ground.
    """
    nodes, d = coordinates.shape
    x = coordinates - coordinates.mean(axis=0)
    pairs = list(permutations(range(d), 2))
    fields = np.zeros((1 + len(pairs) + d, nodes, d))
    fields[0] = x
    for field, (i, j) in zip(fields[1:], pairs, strict=False):
        field[:, i] = x[:, j]
    fields[-d:] = np.eye(d)[:, None]
    u = fields.reshape(len(fields), -1).T
    energies = np.sum(u * (stiffness @ u), axis=0)
    dilatation, shear, springs = float(energies[0]), float(energies[1:-d].min()), energies[-d:]
    # a bound of what springs add to the dilatation
    ground = float(springs @ np.abs(x).max(axis=0) ** 2)
    return dilatation / d**2 / shear if shear > 0.0 and ground <= dilatation / 2 else 1.0


def compressibility(subdomains: Iterable[Subdomain]) -> dict[int, float]:
    """Return kappa / mu of each different stiffness matrix, by its `id`."""
    ratios = dict[int, float]()
    for s in subdomains:
        if id(s.stiffness) not in ratios:
            ratios[id(s.stiffness)] = bulk_over_shear(s.stiffness, s.coordinates_in_frame)
    return ratios


def share_of_shear(ratio: float, gdim: int) -> float:
    """Return the share of the diagonal of K that shear has, for a ratio kappa / mu.

    A node's stiffness is lambda + (d + 1) mu times an integral. Up to the ratio
    `NEARLY_INCOMPRESSIBLE` all of the diagonal counts.
    """
    if ratio <= NEARLY_INCOMPRESSIBLE:
        return 1.0
    return (gdim + 1.0) / (ratio - 2.0 / gdim + gdim + 1.0)
