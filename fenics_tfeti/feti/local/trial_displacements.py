"""Linear and bending displacements of a subdomain: Rayleigh quotients without solves.

In a uniform material both are in equilibrium without forces inside, but for Poisson's ratio in
bending. So their energies are those of the Schur complement, too, of their values on the interface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement, permutations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class TrialDisplacements:
    """Trial displacements of a class of congruent subdomains, and their energies."""

    values: Vector  # (k, b): on the interface unknowns, strains first
    energies: Vector  # (k,): u'Ku [J]
    strains: int  # number of those that are linear

    @staticmethod
    def build(
        stiffness: sp.csr_matrix, coordinates: Vector, unknowns: Numbers
    ) -> TrialDisplacements:
        """Make those of a stiffness matrix (n, n), coordinates (nodes, gdim) in its frame [m]."""
        linear, curved = strains(coordinates), bending(coordinates)
        # what comes after the displacements is the ground
        u = np.zeros((len(linear) + len(curved), stiffness.shape[0]))
        u[:, : coordinates.size] = np.concatenate([linear, curved])
        energies = np.sum(u.T * (stiffness @ u.T), axis=0)
        return TrialDisplacements(u[:, unknowns], energies, len(linear))

    def largest(self, squares: Vector) -> float:
        """Return the largest quotient of squares (j,), of the first displacements, and energies."""
        energies = self.energies[: squares.size]
        # an indefinite stiffness may have none
        some = energies > 0.0
        return float((squares[some] / energies[some]).max(initial=0.0))


def strains(coordinates: Vector) -> Vector:
    """Return the d (d + 1) / 2 uniform strains along principal axes as rows (k, d * nodes)."""
    x, axes = _principal(coordinates)
    rows = []
    for i, j in combinations_with_replacement(range(x.shape[1]), 2):
        u = np.zeros(x.shape)
        u[:, i] += x[:, j]
        u[:, j] += x[:, i]
        rows.append((u @ axes.T).ravel())
    return np.array(rows)


def bending(coordinates: Vector) -> Vector:
    """Return the bending of each principal axis towards each other one, as rows (k, d * nodes)."""
    x, axes = _principal(coordinates)
    rows = []
    for i, j in permutations(range(x.shape[1]), 2):
        u = np.zeros(x.shape)
        u[:, i] = -x[:, i] * x[:, j]
        u[:, j] = 0.5 * x[:, i] ** 2
        rows.append((u @ axes.T).ravel())
    return np.array(rows)


def _principal(coordinates: Vector) -> tuple[Vector, Vector]:
    """Return coordinates along the principal axes through the middle, and the axes as columns."""
    x = coordinates - coordinates.mean(axis=0)
    axes: Vector = np.linalg.eigh(x.T @ x)[1]
    return x @ axes, axes
