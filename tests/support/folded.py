"""Strips bent along curves, whose surface faces itself: folds, rings and spirals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx.mesh import meshtags

from fenics_tfeti.fem.topology import exterior_facets
from fenics_tfeti.io import Box, boxes, tag_facets

INSIDE, OUTSIDE, ENDS = 1, 2, 3

Curve = Callable[[Any], tuple[Any, Any, Any]]


def strip(
    length: float,
    thick: float,
    cells: int,
    curve: Curve,
    comm: Any = MPI.COMM_SELF,
    layers: int = 2,
) -> tuple[Any, Any]:
    """A strip along a curve s -> (x, y, angle of its axis), and tags of its sides and ends."""
    box = Box((0, -thick / 2), (length, thick / 2), (cells, layers))
    mesh = boxes(comm, [box], "quadrilateral").mesh
    s, y = mesh.geometry.x[:, :2].T.copy()
    tags = tag_facets(
        mesh,
        {
            INSIDE: lambda x: np.isclose(x[1], -thick / 2),
            OUTSIDE: lambda x: np.isclose(x[1], thick / 2),
            ENDS: lambda x: np.isclose(x[0], 0) | np.isclose(x[0], length),
        },
    )
    x0, y0, angle = curve(s)
    x = np.column_stack([x0 - y * np.sin(angle), y0 + y * np.cos(angle)])
    mesh.geometry.x[:, :2] = x
    return mesh, tags


def serpentine(leg: float, pitch: float, sheets: int) -> tuple[Curve, float]:
    """Straight legs joined by half circles, and the length; the sheets' axes are pitch apart."""
    turn = np.pi * pitch / 2

    def curve(s: Any) -> tuple[Any, Any, Any]:
        k = np.minimum((s // (leg + turn)).astype(int), sheets - 1)
        rest = s - k * (leg + turn)
        sign = np.where(k % 2 == 0, 1.0, -1.0)
        angle = np.where(rest <= leg, 0.0, (rest - leg) / (pitch / 2))
        x = np.where(k % 2 == 0, 0.0, leg) + sign * np.minimum(rest, leg)
        x = x + sign * pitch / 2 * np.sin(angle)
        y = k * pitch + pitch / 2 * (1 - np.cos(angle))
        return x, y, np.where(k % 2 == 0, angle, np.pi - angle)

    return curve, sheets * leg + (sheets - 1) * turn


def spiral(first: float, pitch: float) -> Curve:
    """Turns of a spiral that begins at a radius."""
    t = np.linspace(0, 40, 40001)
    r = first + pitch * t / (2 * np.pi)
    steps = np.hypot(np.diff(r * np.cos(t)), np.diff(r * np.sin(t)))
    length = np.append(0, np.cumsum(steps))

    def curve(s: Any) -> tuple[Any, Any, Any]:
        a = np.interp(s, length, t)
        radius = first + pitch * a / (2 * np.pi)
        return radius * np.cos(a), radius * np.sin(a), a + np.pi / 2

    return curve


def arc(radius: float) -> Curve:
    """A circle, once around anticlockwise: the strip's outside is towards its centre."""
    return lambda s: (radius * np.sin(s / radius), -radius * np.cos(s / radius), s / radius)


def tags_of_boundary(mesh: Any) -> Any:
    """One tag, 1, for the whole boundary."""
    owned = mesh.topology.index_map(mesh.topology.dim - 1).size_local
    facets = np.flatnonzero(exterior_facets(mesh)[:owned]).astype(np.int32)
    return meshtags(mesh, mesh.topology.dim - 1, facets, np.ones_like(facets))
