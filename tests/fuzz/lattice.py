"""Grids of bilinear or trilinear elements on a lattice, assembled without dolfinx."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]


def lattice_points(*elements: int) -> Numbers:
    """Return the lattice positions of a grid with so many elements along each axis."""
    ranges = (range(n + 1) for n in elements)
    return np.array(list(itertools.product(*ranges)), dtype=np.int64)


def gauss_points(edges: Vector) -> Iterator[tuple[list[Vector], float]]:
    """Yield the gradients of shape functions, by axis, and the weights of two points an axis.

    Nodes are in the order of `itertools.product`.
    """
    gdim = len(edges)
    corners = np.array(list(itertools.product((-1, 1), repeat=gdim)))
    for point in itertools.product((-(3**-0.5), 3**-0.5), repeat=gdim):
        one = 1.0 + corners * np.array(point)
        gradient = [
            corners[:, i] * np.prod(np.delete(one, i, axis=1), axis=1) / 2**gdim * 2 / edges[i]
            for i in range(gdim)
        ]
        yield gradient, float(np.prod(np.asarray(edges) / 2.0))


def element_stiffness(edges: Vector, poisson: float) -> Vector:
    """Return the stiffness of a box-shaped element for Young's modulus 1 (2D: plane strain)."""
    gdim = len(edges)
    mu = 1.0 / (2.0 * (1.0 + poisson))
    lam = poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    shears = list(itertools.combinations(range(gdim), 2))
    C = np.diag([2.0 * mu] * gdim + [mu] * len(shears))
    C[:gdim, :gdim] += lam
    n = gdim * 2**gdim
    K = np.zeros((n, n))
    for gradient, weight in gauss_points(edges):
        strain = np.zeros((len(C), n))
        for i in range(gdim):
            strain[i, i::gdim] = gradient[i]
        for row, (i, j) in enumerate(shears, start=gdim):
            strain[row, i::gdim], strain[row, j::gdim] = gradient[j], gradient[i]
        K += strain.T @ C @ strain * weight
    return 0.5 * (K + K.T)


def element_of_stress(stress: Vector) -> Vector:
    """Return the geometric stiffness of a square or cube of size 1 with a stress (gdim, gdim)."""
    gdim = len(stress)
    points = gauss_points(np.ones(gdim))
    K = sum(np.transpose(g) @ stress @ np.array(g) * weight for g, weight in points)
    return np.kron(K, np.identity(gdim))


def grid_stiffness(elements: tuple[int, ...], element: Vector) -> sp.csr_matrix:
    """Return the stiffness of a grid of elements: of one matrix (n, n), or one each (k, n, n)."""
    rows, columns = _pattern(elements)
    size = len(elements) * int(np.prod(np.add(elements, 1)))
    every = np.broadcast_to(element, (int(np.prod(elements)), *element.shape[-2:]))
    return sp.csr_matrix((every.ravel(), (rows, columns)), shape=(size, size))


def box_stiffness(n: int, edges: Vector, poisson: float) -> sp.csr_matrix:
    """Return the stiffness of a box of n^gdim elements for Young's modulus 1."""
    edges = np.asarray(edges, dtype=float)
    return grid_stiffness((n,) * edges.size, element_stiffness(edges / n, poisson))


@lru_cache(maxsize=None)
def _pattern(elements: tuple[int, ...]) -> tuple[Numbers, Numbers]:
    gdim = len(elements)
    strides = np.cumprod([1, *(n + 1 for n in elements[:0:-1])])[::-1]
    cells = np.array(list(itertools.product(*map(range, elements))))
    corners = np.array(list(itertools.product((0, 1), repeat=gdim)))
    nodes = (cells[:, None] + corners) @ strides
    unknowns = (gdim * nodes[:, :, None] + np.arange(gdim)).reshape(len(cells), -1)
    k = unknowns.shape[1]
    return np.repeat(unknowns, k, axis=1).ravel(), np.tile(unknowns, (1, k)).ravel()
