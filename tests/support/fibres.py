"""Torn systems without dolfinx: a block with stiff fibres that subdomains cut, under a punch.

The block is a grid of subdomains, each a grid of squares or cubes; so is the punch, which may move
up and down on the middle of the block.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.feti import ContactRows, Prescribed, Subdomain, TornSystem

POISSON = 0.3
# of the numbers of nodes along an axis
FAR = 1000


def element(gdim: int) -> np.ndarray:
    """Return the stiffness of a square (in plane strain) or cube of size and modulus 1."""
    corners = np.array(list(itertools.product((-1, 1), repeat=gdim)))
    mu, lmbda = 1.0 / (2 * (1 + POISSON)), POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    pairs = [(i, j) for i in range(gdim) for j in range(i + 1)]
    C = np.diag([2 * mu if i == j else mu for i, j in pairs])
    diagonal = np.array([i == j for i, j in pairs])
    C[np.ix_(diagonal, diagonal)] += lmbda
    K = np.zeros((gdim * len(corners),) * 2)
    for point in itertools.product((-(3**-0.5), 3**-0.5), repeat=gdim):
        one = 1 + corners * np.array(point)
        gradient = 2.0 * np.stack(
            [
                corners[:, i] * np.prod(np.delete(one, i, axis=1), axis=1) / 2**gdim
                for i in range(gdim)
            ]
        )
        strain = np.zeros((len(pairs), K.shape[0]))
        for row, (i, j) in enumerate(pairs):
            strain[row, i::gdim] = gradient[j]
            if i != j:
                strain[row, j::gdim] = gradient[i]
        K += strain.T @ C @ strain / 2**gdim
    return K


def subdomain(
    corner: tuple[int, ...],
    shape: tuple[int, ...],
    modulus: Callable[[np.ndarray], np.ndarray],
    body: int,
) -> Subdomain:
    """Return a grid of elements from a corner of the lattice; nodes are numbered by places."""
    gdim = len(corner)
    lattice = np.array(list(itertools.product(*(range(k + 1) for k in shape))))
    cells = np.array(list(itertools.product(*map(range, shape))))
    corners = np.array(list(itertools.product((0, 1), repeat=gdim)))
    strides = np.cumprod([1, *(k + 1 for k in shape[:0:-1])])[::-1]
    places = (cells[:, None] + corners) @ strides
    unknowns = (gdim * places[:, :, None] + np.arange(gdim)).reshape(len(cells), -1)
    E = modulus(cells + np.array(corner) + 0.5)
    values = E[:, None, None] * element(gdim)
    k = unknowns.shape[1]
    rows, columns = np.repeat(unknowns, k, axis=1), np.tile(unknowns, (1, k))
    size = gdim * len(lattice)
    K = sp.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (size, size))
    position = lattice + np.array(corner)
    nodes = position @ FAR ** np.arange(gdim)[::-1] + body * FAR**gdim
    return Subdomain(K, np.zeros(size), position.astype(float), nodes, body)


def reinforced_block(
    gdim: int = 2,
    ratio: float = 1e4,
    *,
    n: int = 6,
    columns: int = 3,
    layers: int = 2,
    force: float = 1.0,
) -> TornSystem:
    """Return a clamped block with fibres along x, under a punch of one or two subdomains.

    Parameters
    ----------
    gdim : int
        2 or 3; in 3D block and punch are two elements deep, the fibres one.
    ratio : float
        Modulus of the fibres relative to that of block and punch.
    n, columns, layers : int
        Elements along an edge of a subdomain, at least 6; subdomains of the block along x, and of
        its height. Each layer has two fibres.
    force : float
        On the punch, downward.
    """

    def modulus(x: np.ndarray) -> np.ndarray:
        height = x[:, -1] % (0.5 * n)
        stiff = (height > 1.0) & (height < 0.5 * n - 1.0) & (x[:, -1] < n * layers)
        return np.where(stiff & ((gdim == 2) | (x[:, 1] < 1.0)), ratio, 1.0)

    shape = (n, *[2] * (gdim - 2), n)
    grid = itertools.product(range(columns), *[range(1)] * (gdim - 2), range(layers))
    block = [subdomain(tuple(n * i for i in place), shape, modulus, 0) for place in grid]
    top = n * layers
    middle = range((columns - 1) // 2, columns // 2 + 1)
    punch = [subdomain((n * i, *[0] * (gdim - 2), top), shape, modulus, 1) for i in middle]
    prescribed = [(s.nodes[s.coordinates[:, -1] == 0.0], range(gdim)) for s in block]
    slaves = np.zeros(0, dtype=np.int64)
    for s in punch:
        loaded = s.coordinates[:, -1] == top + n
        s.load[gdim * np.flatnonzero(loaded) + gdim - 1] = -force / loaded.sum() / len(punch)
        prescribed.append((s.nodes[loaded], range(gdim - 1)))
        slaves = np.union1d(slaves, s.nodes[s.coordinates[:, -1] == top])
    normal = np.zeros((slaves.size, gdim))
    normal[:, -1] = -1.0
    rows = ContactRows.node_to_node(
        slaves,
        slaves - FAR**gdim,
        normal,
        np.zeros(slaves.size),
        np.zeros(slaves.size, dtype=np.int64),
    )
    nodes = np.concatenate([np.repeat(some, len(c)) for some, c in prescribed])
    components = np.concatenate([np.tile(c, some.size) for some, c in prescribed])
    fixed = Prescribed(nodes, components, np.zeros(nodes.size))
    return TornSystem([*block, *punch], fixed, rows, gdim, ["block", "punch"], ["joint"])
