"""Pairs of slave and master facets that may lie over each other; no search distance is given."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fenics_tfeti.fem.contact.mortar.facets import Facets, Planes, highest, lowest
from fenics_tfeti.fem.contact.surfaces.box_tree import BoxTree
from fenics_tfeti.typing import Mask, Numbers, Vector

# Cosine between the normals of two facets, below which they face each other: 96 degrees.
FACING = -0.1


# How far the master is looked for, relative to a slave facet's distance from the master's nodes and
# centres: enough where the surfaces are inclined to each other by up to 60 degrees.
REACH = 2.0


class MasterTree:
    """The pieces of a master's surface, to be found from the slave's."""

    def __init__(self, master: Facets) -> None:
        x = master.coordinates()
        self.facets, self.planes = master, Planes.of(x)
        self._tree, self._low, self._high = BoxTree(x), lowest(x), highest(x)
        nodes = master.points[np.unique(master.pieces)]
        self._places = cKDTree(np.concatenate([nodes, self.planes.origin]))

    def reach(self, slave: Facets, planes: Planes) -> Vector:
        """Return how far before and behind each piece (p,) the master is looked for [m].

        It is `REACH` times the piece's distance from the nodes and centres of the master, and its
        diameter more.
        """
        nodes, inverse = np.unique(slave.pieces, return_inverse=True)
        distance = self._places.query(slave.points[nodes])[0]
        farthest = distance[inverse.reshape(slave.pieces.shape)].max(axis=1)
        reach: Vector = REACH * farthest + planes.diameter
        return reach

    def candidates(self, x: Vector, planes: Planes, reach: Vector) -> tuple[Numbers, Numbers]:
        """Find the pieces of the master that face those of the slave and may lie over them.

        The pieces of the slave have the corners x (p, v, gdim) and their planes. Pairs (slave,
        master) are in the order of the slave's pieces; each once.
        """
        frames = planes.project(np.arange(len(x)), x)
        low, high = lowest(frames), highest(frames)
        low[:, -1] -= reach
        high[:, -1] += reach
        # the box around the facet's prism along its normal
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        centre = planes.origin + np.einsum("fa,fad->fd", middle, planes.axes)
        extent = np.einsum("fa,fad->fd", half, np.abs(planes.axes))
        upper, lower = ((centre + side * extent).T.copy() for side in (1.0, -1.0))

        def overlaps(row: Numbers, box_low: Vector, box_high: Vector) -> Mask:
            overlapping = np.ones(row.size, dtype=bool)
            for axis, (top, bottom) in enumerate(zip(upper, lower, strict=True)):
                overlapping &= box_low[:, axis] <= top.take(row)
                overlapping &= box_high[:, axis] >= bottom.take(row)
            return overlapping

        slave, master = self._tree.candidates(len(x), overlaps)
        close = overlaps(slave, self._low.take(master, axis=0), self._high.take(master, axis=0))
        slave, master = slave[close], master[close]
        normals = (planes.normal.take(slave, axis=0), self.planes.normal.take(master, axis=0))
        faces = np.einsum("kd,kd->k", *normals) < FACING
        return slave[faces], master[faces]
