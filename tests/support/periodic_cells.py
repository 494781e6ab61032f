"""Periodic cells, and sectors of rings, with bodies in contact inside them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from mesh_arrays import concatenated, merged, mesh_of, tags_of
from scenes import Scene, at

from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, PeriodicPair
from fenics_tfeti.io import Box, boxes, tag_facets

EDGE = 0.5  # half of a grain [m]


def periodic_pairs(tags: Any, size: Any, strain: Any) -> list[PeriodicPair]:
    """Return a pair for each axis: the masters have the tags 1, 3, ..., the slaves 2, 4, ..."""
    shifts = np.diag(size)
    return [
        PeriodicPair(tags, 2 * k + 2, 2 * k + 1, translation=t, jump=strain @ t)
        for k, t in enumerate(shifts)
    ]


def homogeneous_cell(cell: str, strain: Any, degree: int = 1, comm: Any = MPI.COMM_SELF) -> Scene:
    """Return a box, periodic along all axes, of a strain."""
    gdim = len(strain)
    size = np.array([1.0, 1.5, 0.8])[:gdim]
    body = Box((0.0,) * gdim, tuple(size), (2, 3, 2)[:gdim])
    ends = [(2 * k + 1 + end, at(k, end * size[k])) for k in range(gdim) for end in range(2)]
    scene = Scene.of_boxes(comm, cell, [body], ends, degree=degree)
    scene.contacts = periodic_pairs(scene.facet_tags, size, np.asarray(strain))
    return scene


def grains(
    cells: int, strain: Any, law: Any, n: int = 2, comm: Any = MPI.COMM_SELF
) -> ContactProblem:
    """Return a periodic arrangement of so many cells along each axis, of square grains that touch.

    A cell has a grain in its middle, and parts of three others that its border cuts. Grains differ
    in stiffness, and rub on each other.
    """
    ends = np.append(0.0, EDGE * np.append(np.arange(1, 4 * cells, 2), 4 * cells))
    spans = list(zip(ends[:-1], ends[1:], strict=True))
    parts = [
        Box((x[0], y[0]), (x[1], y[1]), tuple(round(n * (e - s) / EDGE) for s, e in (x, y)))
        for y in spans
        for x in spans
    ]
    bodies = boxes(comm, parts, "quadrilateral")
    size, count, markers, number = ends[-1], len(spans), [], 4
    for k in range(2):
        markers += [(2 * k + 1, at(k, 0.0)), (2 * k + 2, at(k, size))]
    sides = []
    for axis in range(2):
        step = count if axis else 1
        for body in range(count * count):
            place = (body // count if axis else body % count) + 1
            if place == count:
                continue
            markers.append((number + 1, at(axis, ends[place]), body + 1))
            markers.append((number + 2, at(axis, ends[place]), body + step + 1))
            sides.append((number + 1, number + 2))
            number += 2
    tags = tag_facets(bodies.mesh, markers, bodies.cell_tags)
    # stiff grains are in the middles of cells, and at their corners
    young = {
        1 + j * count + i: 2e11 * (1.0 + 3.0 * ((i + j) % 2)) * (1.0 + 0.5 * (i % 2))
        for j in range(count)
        for i in range(count)
    }
    scene = Scene(bodies.mesh, tags, bodies.cell_tags, young=young)
    middle = fem.locate_dofs_geometrical(
        scene.V, lambda x: np.isclose(x[0], 2 * EDGE) & np.isclose(x[1], 2 * EDGE)
    )
    scene.bcs = [fem.dirichletbc(np.zeros(2), middle, scene.V)]
    scene.contacts = [ContactPair(tags, *pair, friction=law) for pair in sides]
    scene.contacts += periodic_pairs(tags, (size, size), np.asarray(strain))
    return scene.problem(cell_tags=None, options={"rtol": 1e-9, "subdomain_size": 100})


SECTOR = {"inner": (2, 1), "outer": (4, 3)}  # slave and master on the borders of a sector


def ring(sectors: int, of: int, comm: Any = MPI.COMM_SELF, law: Any = None) -> ContactProblem:
    """Return so many of a number of sectors of two rings with pads between them, rubbing.

    The bore is fixed, the outside pressed. One sector is a cyclic one.
    """
    n, angle = 8, 2 * np.pi / of
    layers = {1: (1.0, 1.6, 3), 2: (1.6, 2.0, 2), 3: (2.0, 2.6, 3)}
    parts, body = [], list[int]()
    for tag, (inner, outer, m) in layers.items():
        spans = [(0, n * sectors)] if tag != 2 else [(n * k + 2, n * k + 6) for k in range(sectors)]
        for begin, end in spans:
            theta = angle / n * (np.arange(begin, end + 1) % (n * of))
            r = np.linspace(inner, outer, m + 1)[:, None]
            # pads are lower at their ends
            sag = 0.001 * (1.0 - np.sin(np.pi * np.linspace(0, 1, theta.size))) * (tag == 2)
            R = r - (r > 1.9) * sag
            x = np.stack([R * np.cos(theta), R * np.sin(theta)], axis=-1).reshape(-1, 2)
            corner = (np.arange(m)[:, None] * theta.size + np.arange(theta.size - 1)).ravel()
            quads = corner[:, None] + np.array([0, 1, theta.size, theta.size + 1])
            parts.append(merged(x, quads))
            body += [tag] * len(quads)
    domain = mesh_of(comm, "quadrilateral", *concatenated(*parts))
    cell_tags = tags_of(domain, body)

    def near(radius: float) -> Any:
        return lambda x: np.isclose(np.hypot(x[0], x[1]), radius, atol=2e-3)

    def border(direction: float) -> Any:
        normal = -np.sin(direction), np.cos(direction)
        return lambda x: np.isclose(normal[0] * x[0] + normal[1] * x[1], 0.0)

    markers = [(5, near(1.6), 1), (6, near(1.6), 2), (7, near(2.0), 2), (8, near(2.0), 3)]
    markers += [(9, near(2.6)), (10, near(1.0))]
    if sectors < of:
        for tags, part in zip(SECTOR.values(), (1, 3), strict=True):
            markers += [(tags[0], border(angle), part), (tags[1], border(0.0), part)]
    scene = Scene(domain, tag_facets(domain, markers, cell_tags), cell_tags)
    scene.add_load(9, -5e7)
    scene.fix(10)
    scene.contacts = [
        ContactPair(scene.facet_tags, *pair, friction=law) for pair in ((6, 5), (7, 8))
    ]
    if sectors < of:
        c, s = np.cos(angle), np.sin(angle)
        scene.contacts += [
            PeriodicPair(scene.facet_tags, *pair, rotation=[[c, -s], [s, c]], name=name)
            for name, pair in SECTOR.items()
        ]
    return scene.problem(cell_tags=None, options={"rtol": 1e-9, "subdomain_size": 120})
