"""Boxes of bilinear or trilinear elements on a lattice, assembled without dolfinx."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def lattice_points(n: int, gdim: int) -> NDArray[np.int64]:
    """Return the (n + 1)^gdim lattice positions of a box of n^gdim elements."""
    return np.array(list(itertools.product(range(n + 1), repeat=gdim)), dtype=np.int64)


def element_stiffness(edges: Vector, poisson: float) -> Vector:
    """Return the stiffness of a box-shaped element for Young's modulus 1 (2D: plane strain).

    Nodes are in the order of `itertools.product`; two Gauss points along each axis.
    """
    gdim = len(edges)
    corners = np.array(list(itertools.product((-1, 1), repeat=gdim)))
    mu = 1.0 / (2.0 * (1.0 + poisson))
    lam = poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    shears = list(itertools.combinations(range(gdim), 2))
    C = np.diag([2.0 * mu] * gdim + [mu] * len(shears))
    C[:gdim, :gdim] += lam
    n = gdim * len(corners)
    K = np.zeros((n, n))
    for point in itertools.product((-(3**-0.5), 3**-0.5), repeat=gdim):
        one = 1.0 + corners * np.array(point)
        gradient = [
            corners[:, i] * np.prod(np.delete(one, i, axis=1), axis=1) / 2**gdim * 2 / edges[i]
            for i in range(gdim)
        ]
        strain = np.zeros((len(C), n))
        for i in range(gdim):
            strain[i, i::gdim] = gradient[i]
        for row, (i, j) in enumerate(shears, start=gdim):
            strain[row, i::gdim], strain[row, j::gdim] = gradient[j], gradient[i]
        K += strain.T @ C @ strain * np.prod(np.asarray(edges) / 2.0)
    return 0.5 * (K + K.T)


def box_stiffness(n: int, edges: Vector, poisson: float) -> sp.csr_matrix:
    """Return the stiffness of a box of n^gdim elements for Young's modulus 1."""
    edges = np.asarray(edges, dtype=float)
    gdim = len(edges)
    element = element_stiffness(edges / n, poisson).ravel()
    rows, columns = _pattern(n, gdim)
    size = gdim * (n + 1) ** gdim
    values = np.tile(element, n**gdim)
    return sp.csr_matrix((values, (rows, columns)), shape=(size, size))


@lru_cache(maxsize=None)
def _pattern(n: int, gdim: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    strides = (n + 1) ** np.arange(gdim)[::-1]
    rows, columns = [], []
    for cell in itertools.product(range(n), repeat=gdim):
        nodes = np.array(
            [np.add(cell, c) @ strides for c in itertools.product((0, 1), repeat=gdim)]
        )
        unknowns = (gdim * nodes[:, None] + np.arange(gdim)).ravel()
        rows.append(np.repeat(unknowns, unknowns.size))
        columns.append(np.tile(unknowns, unknowns.size))
    return np.concatenate(rows), np.concatenate(columns)
