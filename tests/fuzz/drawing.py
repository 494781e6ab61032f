"""Drawing of scenes: random numbers that are told, frames, boxes, and the table of situations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from posed import SURFACE, Frame, Posed
from scenes import at

Vector = NDArray[np.float64]


Ratios = dict[str, float]

TOP, OTHER, SECOND, FOURTH, LEFT, BACK = SURFACE, SURFACE + 1, SURFACE + 2, SURFACE + 3, 4, 5


class RightError(Exception):
    """An error of the package that is right, in words."""


@dataclass
class Draw:
    """A generator of random numbers, and what was drawn."""

    rng: Generator
    comm: MPI.Comm
    story: list[str] = field(default_factory=list)
    # of the pictures and errors: what was solved last
    posed: Posed | None = None

    def one_of(self, *values: Any, p: Sequence[float] | None = None) -> Any:
        """Draw one of some values."""
        value = values[int(self.rng.choice(len(values), p=p))]
        self.story.append(str(value))
        return value

    def between(self, low: float, high: float) -> float:
        value = float(self.rng.uniform(low, high))
        self.story.append(f"{value:.4g}")
        return value

    def count(self, low: int, high: int) -> int:
        """Draw a number, both ends included."""
        return int(self.one_of(*range(low, high + 1)))

    def cell(self, *cells: str) -> str:
        return str(self.one_of(*(cells or ("quadrilateral", "triangle", "hexahedron"))))

    def frame(self, gdim: int, along_axes: bool = False) -> Frame:
        frame = Frame.draw(self.rng, gdim, along_axes)
        self.story.append(f"frame {frame.turn.round(3).tolist()} {frame.shift.round(3)}")
        self.story.append(f"unit of length {frame.metre:.2e}, of stress {frame.pascal:.2e}")
        return frame

    def pose(
        self,
        frame: Frame,
        cell: str,
        parts: Sequence[Any],
        marks: Sequence[Any],
        method: str = "linear",
        shape: Callable[[Vector], Vector] | None = None,
        **material: Any,
    ) -> Posed:
        """Return a scene of boxes (lower, upper, divisions)."""
        given = {"young": [1.0] * len(parts), "poisson": 0.3, **material}
        if method == "finite" and cell == "hexahedron":
            # compiled in a tenth of the time
            cell = "tetrahedron"
        place = frame.points if shape is None else lambda x: frame.points(shape(x))
        self.posed = Posed.of_boxes(
            self.comm, cell, parts, marks, place, frame=frame, method=method, **given
        )
        self.posed.accuracy["subdomain_size"] = int(self.rng.choice([60, 3000, 3000]))
        self.story.append(f"{method}, {cell}, {parts}, {given}")
        return self.posed


Situation = Callable[[Draw], Ratios]
SITUATIONS: dict[str, tuple[float, Situation]] = {}


def situation(weight: float) -> Callable[[Situation], Situation]:
    """Put a function into the table, with the weight by which it is drawn."""

    def register(function: Situation) -> Situation:
        SITUATIONS[function.__name__] = weight, function
        return function

    return register


def up(gdim: int, length: float = 1.0, along: float = 0.0) -> Vector:
    """Return the vector of a length along the last axis, and of another along the first."""
    vector = np.zeros(gdim)
    vector[-1], vector[0] = length, along
    return vector


def ceiling(gdim: int, level: float, low: float = -np.inf, high: float = np.inf) -> Any:
    """Return the half space above a level, of the last coordinate, between two first ones."""

    def obstacle(x: Vector) -> tuple[Vector, Vector]:
        gap = level - x[-1]
        inside = (x[0] > low - 1e-6) & (x[0] < high + 1e-6)
        return np.where(inside, gap, np.inf), -up(gdim)

    return obstacle


def layer(gdim: int, level: float, low: float = -np.inf, high: float = np.inf) -> Any:
    """Return a marker of a level of the last coordinate, between two first ones."""
    return lambda x: np.isclose(x[gdim - 1], level) & (x[0] > low - 1e-6) & (x[0] < high + 1e-6)


def levels(axis: int, *marks: tuple[Any, ...]) -> list[Any]:
    """Return markers (tag, marker, body) of levels of one axis, given as (tag, level, body)."""
    return [(tag, at(axis, level), *body) for tag, level, *body in marks]


def block(gdim: int, length: float, n: int, low: float = 0.0, height: float = 1.0) -> Any:
    """Return a box of a length along the first axis, with n cells a metre."""
    corner, size = np.zeros(gdim), np.ones(gdim)
    corner[-1], size[0], size[-1] = low, length, height
    divisions = [max(1, round(n * s)) for s in size]
    return tuple(corner), tuple(corner + size), tuple(divisions)


def worst(*every: Ratios) -> Ratios:
    """Return the largest ratio of each name."""
    whole: Ratios = {}
    for ratios in every:
        for name, value in ratios.items():
            whole[name] = max(whole.get(name, 0.0), value)
    return whole
