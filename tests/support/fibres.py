"""Torn systems without dolfinx: a block with stiff fibres that subdomains cut, under a punch.

The block is a grid of subdomains, each a grid of squares or cubes; so is the punch, which may move
up and down on the middle of the block.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from lattice import element_stiffness, grid_stiffness, lattice_points
from torn import node_rows

from fenics_tfeti.feti import Prescribed, Subdomain, TornSystem

POISSON = 0.3
# of the numbers of nodes along an axis
FAR = 1000


def subdomain(
    corner: tuple[int, ...],
    shape: tuple[int, ...],
    modulus: Callable[[np.ndarray], np.ndarray],
    body: int,
) -> Subdomain:
    """Return a grid of elements from a corner of the lattice; nodes are numbered by places."""
    gdim = len(corner)
    cells = np.array(list(itertools.product(*map(range, shape))))
    E = modulus(cells + np.array(corner) + 0.5)
    K = grid_stiffness(shape, E[:, None, None] * element_stiffness(np.ones(gdim), POISSON))
    position = lattice_points(*shape) + np.array(corner)
    nodes = position @ FAR ** np.arange(gdim)[::-1] + body * FAR**gdim
    return Subdomain(K, np.zeros(K.shape[0]), position.astype(float), nodes, body)


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

    In 3D block and punch are two elements deep, the fibres one; `ratio` is their modulus relative
    to that of block and punch. An edge of a subdomain has n >= 6 elements; the block has `columns`
    by `layers` of them, each layer with two fibres. The force on the punch is downward.
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
    rows = node_rows(slaves, -np.eye(gdim)[-1], slaves - FAR**gdim)
    nodes = np.concatenate([np.repeat(some, len(c)) for some, c in prescribed])
    components = np.concatenate([np.tile(c, some.size) for some, c in prescribed])
    fixed = Prescribed(nodes, components, np.zeros(nodes.size))
    return TornSystem([*block, *punch], fixed, rows, gdim, ["block", "punch"], ["joint"])
