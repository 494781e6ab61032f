"""Linear and bending displacements of a subdomain: Rayleigh quotients without solves.

In a uniform material both are in equilibrium without forces inside, but for Poisson's ratio in
bending. So their energies are those of the Schur complement, too, of their values on the interface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from fenics_tfeti.feti.tolerances import ZERO
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class TrialDisplacements:
    """Trial displacements of a class of congruent subdomains, and their energies."""

    values: Vector  # (k, b): on the interface unknowns, strains first
    energies: Vector  # (k, k): u_i'Ku_j [J]
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
        return TrialDisplacements(u[:, unknowns], u @ (stiffness @ u.T), len(linear))

    def largest(self, form: Vector) -> float:
        """Return the largest quotient of a quadratic form and the energy.

        The form (j, j) is that of sums of the first displacements. Sums are compared, as each of
        the displacements depends on the choice of axes.
        """
        energies = self.energies[: len(form), : len(form)]
        # an indefinite stiffness may have none
        some = energies.diagonal() > 0.0
        size = np.sqrt(energies.diagonal()[some])
        E, A = (x[np.ix_(some, some)] / np.outer(size, size) for x in (energies, form))
        values, vectors = np.linalg.eigh(E)
        positive = values > ZERO * values.max(initial=0.0)
        vectors = vectors[:, positive] / np.sqrt(values[positive])
        return float(np.linalg.eigvalsh(vectors.T @ A @ vectors).max(initial=0.0))


def strains(coordinates: Vector) -> Vector:
    """Return the d (d + 1) / 2 uniform strains as rows (k, d * nodes)."""
    x = coordinates - coordinates.mean(axis=0)
    rows = []
    for i, j in combinations_with_replacement(range(x.shape[1]), 2):
        u = np.zeros(x.shape)
        u[:, i] += x[:, j]
        u[:, j] += x[:, i]
        rows.append(u.ravel())
    return np.array(rows)


def bending(coordinates: Vector) -> Vector:
    """Return displacements whose sums are those of bending any axis towards another one.

    The bending of a unit vector a towards b, across it, is -(a'x)(b'x) a + (a'x)^2 b / 2, the sum
    of T_ijk (x_i x_j e_k - x_i x_k e_j - x_j x_k e_i) / 2 for T = a a b; the tensors T that are
    symmetric in i and j, with T_iki = 0, are sums of such products. Rows (k, d * nodes), 15 in
    three dimensions and 4 in two.
    """
    x = (coordinates - coordinates.mean(axis=0)).T
    i, j, factors = _quadratic(len(x))
    rows = np.tensordot(factors, x[i] * x[j], axes=(0, 0))
    return rows.swapaxes(1, 2).reshape(len(rows), -1)


@cache
def _quadratic(gdim: int) -> tuple[Numbers, Numbers, Vector]:
    """Return i and j (q,) of products x_i x_j, and their factors (q, k, gdim) in the bendings."""
    units, pairs = np.identity(gdim), list(combinations_with_replacement(range(gdim), 2))
    tensors = [
        np.einsum("i,j,k->ijk", units[i], units[j], units[k])
        + np.einsum("i,j,k->ijk", units[j], units[i], units[k])
        for i, j in pairs
        for k in range(gdim)
    ]
    traces = np.array([np.einsum("iki->k", T) for T in tensors])
    T = np.tensordot(scipy.linalg.null_space(traces.T).T, np.array(tensors), 1)
    factors = 0.5 * T - T.swapaxes(2, 3)
    i, j = np.transpose(pairs)
    both = factors[:, i, j] + np.where(i == j, 0.0, 1.0)[:, None] * factors[:, j, i]
    return i, j, both.swapaxes(0, 1)
