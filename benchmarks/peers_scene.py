"""Meshes of `peers.py` as arrays, and the answer that every code returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

YOUNG, POISSON, TRACTION = 2.1e11, 0.3, 20e6  # [Pa], [-], [Pa]
LAMBDA = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
MU = YOUNG / (2 * (1 + POISSON))
# the rigid ground is flat up to x = 2 m, then a parabola with this coefficient [1/m]
GROUND_SLOPE = 2e-3


@dataclass(frozen=True)
class Scene:
    """Boxes meshed by cubes; each box is a body.

    Attributes
    ----------
    points : (n, 3) array
        Nodes [m], those of one body after those of the other.
    cells : (m, 8) array
        Their nodes, with vertices numbered x + 2 y + 4 z.
    body : (m,) array
        1 for the lower beam, 2 for the upper one.
    divisions : int
        Elements per metre.
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    body: NDArray[np.int32]
    divisions: int

    def nodes_of(self, body: int) -> NDArray[np.int64]:
        """Return the nodes of a body."""
        return np.unique(self.cells[self.body == body])


@dataclass
class Answer:
    """The solution of a code.

    Attributes
    ----------
    coordinates, displacement : (n, 3) array
        Nodes and their displacements [m], in any order within a body.
    body : (n,) array
        Body of each node.
    force : float
        Sum of the contact forces [N].
    facts : dict
        Number of iterations and other figures to print.
    """

    coordinates: NDArray[np.float64]
    displacement: NDArray[np.float64]
    body: NDArray[np.int32]
    force: float
    facts: dict[str, Any] = field(default_factory=dict)


def two_beams(divisions: int) -> Scene:
    """Return the two beams of demos/two_beams.py."""
    return _scene(divisions, {1: (0.0, 0.0), 2: (1.0, 1.0)})


def one_beam(divisions: int) -> Scene:
    """Return the upper beam alone, to be used with a rigid ground."""
    return _scene(divisions, {2: (1.0, 1.0)})


SCENES = {"two beams": two_beams, "one beam on rigid ground": one_beam}


def ground_gap(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gap [m] below the one beam at points (3, n): zero up to x = 2, then growing."""
    return np.asarray(GROUND_SLOPE * np.maximum(x[0] - 2.0, 0.0) ** 2 + x[2] - 1.0)


def sort_key(coordinates: NDArray[np.float64], body: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return a permutation that sorts the nodes of any code in the same way."""
    x, y, z = np.round(coordinates, 6).T
    return np.asarray(np.lexsort((z, y, x, body)))


def _scene(n: int, corners: dict[int, tuple[float, float]]) -> Scene:
    points, cells, bodies, first = [], [], [], 0
    for body, (x0, z0) in corners.items():
        axes = [np.linspace(x0, x0 + 2, 2 * n + 1), np.linspace(0, 1, n + 1)]
        axes.append(np.linspace(z0, z0 + 1, n + 1))
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        points.append(np.column_stack([x.ravel(), y.ravel(), z.ravel()]))
        number = first + np.arange(x.size).reshape(x.shape)
        low, high = slice(None, -1), slice(1, None)
        corner = [(c, b, a) for c in (low, high) for b in (low, high) for a in (low, high)]
        cells.append(np.column_stack([number[place].ravel() for place in corner]))
        bodies.append(np.full(len(cells[-1]), body, dtype=np.int32))
        first += x.size
    return Scene(np.concatenate(points), np.concatenate(cells), np.concatenate(bodies), n)
