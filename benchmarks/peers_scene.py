"""Meshes of `peers.py` as arrays, and the answer that every code returns."""

from __future__ import annotations

import resource
from collections.abc import Callable
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
        Elements per metre of the upper beam, whose lower face is the slave.
    lower_divisions : int
        Elements per metre of the lower beam.
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    body: NDArray[np.int32]
    divisions: int
    lower_divisions: int

    def node_body(self) -> NDArray[np.int32]:
        """Return the body of each node."""
        body = np.zeros(len(self.points), dtype=np.int32)
        body[self.cells] = self.body[:, np.newaxis]
        return body

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
    pressure : (n,) array
        Contact force of the nodes of the slave over the area that belongs to them [Pa], NaN at all
        other nodes.
    """

    coordinates: NDArray[np.float64]
    displacement: NDArray[np.float64]
    body: NDArray[np.int32]
    force: float
    facts: dict[str, Any] = field(default_factory=dict)
    pressure: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Without pressures, all of them are NaN."""
        if not self.pressure.size:
            self.pressure = np.full(len(self.coordinates), np.nan)


def two_beams(divisions: int) -> Scene:
    """Return the two beams of demos/two_beams.py."""
    return _scene(divisions, {1: (0.0, 0.0), 2: (1.0, 1.0)})


def two_beams_apart(ratio: float) -> Callable[[int], Scene]:
    """Return a function that makes the two beams with the lower one meshed `ratio` times finer."""

    def scene(divisions: int) -> Scene:
        return _scene(divisions, {1: (0.0, 0.0), 2: (1.0, 1.0)}, round(ratio * divisions))

    return scene


def one_beam(divisions: int) -> Scene:
    """Return the upper beam alone, to be used with a rigid ground."""
    return _scene(divisions, {2: (1.0, 1.0)})


SCENES = {
    "two beams": two_beams,
    "two beams, meshes 1:1.4": two_beams_apart(1.4),
    "two beams, meshes 1:3": two_beams_apart(3.0),
    "one beam on rigid ground": one_beam,
}


def ground_gap(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gap [m] below the one beam at points (3, n): zero up to x = 2, then growing."""
    return np.asarray(GROUND_SLOPE * np.maximum(x[0] - 2.0, 0.0) ** 2 + x[2] - 1.0)


def nodal_load(scene: Scene) -> NDArray[np.float64]:
    """Return the nodal forces in z of the traction on the top and the end of the upper beam."""
    force = np.zeros(len(scene.points))
    vertices = scene.points[scene.cells]
    for axis, place in ((2, 2.0), (0, 1.0)):
        on_face = np.isclose(vertices[..., axis], place)
        faces = (on_face.sum(axis=1) == 4) & (scene.body == 2)
        nodes = scene.cells[faces][on_face[faces]]
        np.add.at(force, nodes, -TRACTION / (4.0 * scene.divisions**2))
    return force


def slave_nodes(scene: Scene) -> NDArray[np.int64]:
    """Return the nodes of the upper beam that face the lower one."""
    nodes = scene.nodes_of(2)
    x = scene.points[nodes]
    return nodes[np.isclose(x[:, 2], 1.0) & (x[:, 0] < 2.0 + 1e-9)]


def slave_areas(scene: Scene) -> NDArray[np.float64]:
    """Return the areas [m^2] that belong to `slave_nodes`."""
    x, y = scene.points[slave_nodes(scene)].T[:2]
    halves = [
        np.where(np.isclose(t % 1.0, 0.0) | np.isclose(t % 1.0, 1.0), 0.5, 1.0) for t in (x, y)
    ]
    return np.asarray(halves[0] * halves[1] / scene.divisions**2)


def sort_key(coordinates: NDArray[np.float64], body: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return a permutation that sorts the nodes of any code in the same way."""
    x, y, z = np.round(coordinates, 6).T
    return np.asarray(np.lexsort((z, y, x, body)))


def processor_seconds() -> float:
    """Return processor seconds of this process and of its finished children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _scene(
    divisions: int, corners: dict[int, tuple[float, float]], lower_divisions: int | None = None
) -> Scene:
    points, cells, bodies, first = [], [], [], 0
    lower = lower_divisions or divisions
    for body, (x0, z0) in corners.items():
        n = lower if body == 1 else divisions
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
    columns = (np.concatenate(parts) for parts in (points, cells, bodies))
    return Scene(*columns, divisions, lower)
