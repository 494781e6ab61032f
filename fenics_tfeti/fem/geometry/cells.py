"""The cells of integration: where master facets lie over slave facets, in the slave's planes.

No search distance is given. Facets of degree 2 are projected piece by piece; here a facet is one of
these pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fenics_tfeti.fem.geometry.box_tree import BoxTree
from fenics_tfeti.fem.geometry.clipping import clip_intervals, clip_polygons, fan_triangles
from fenics_tfeti.fem.geometry.faceted import FacetedSurface
from fenics_tfeti.fem.geometry.facets import Facets, Planes, reference_coordinates, shape_functions
from fenics_tfeti.fem.geometry.vectors import centres, highest, lowest
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Mask, Numbers, Vector

# How far the master is looked for, relative to a slave facet's distance from the master's nodes and
# centres: enough where the surfaces are inclined to each other by up to 60 degrees.
REACH = 2.0
# part of a slave facet's length or area that is rounding
_SLIVER = 1e-12


class MasterTree:
    """The pieces of a master's surface, to be found from the slave's."""

    def __init__(self, master: Facets) -> None:
        self.facets, self.planes = master, master.planes
        self._tree = BoxTree(master.apart(master.pieces))

    def reach(self, slave: Facets, planes: Planes) -> Vector:
        """Return how far before and behind each piece (p,) the master is looked for [m]."""
        master, is_used = self.facets, np.zeros(len(self.facets.points), dtype=bool)
        is_used[master.pieces] = True
        places = [master.apart(np.flatnonzero(is_used)), centres(master.apart(master.pieces))]
        points = slave.apart(np.arange(len(slave.points)))
        distance = cKDTree(np.concatenate(places)).query(points)[0]
        farthest = highest(distance[slave.pieces, None])[:, 0]
        return REACH * farthest + planes.diameter

    def candidates(
        self, slave_facets: Facets, chosen: Numbers, planes: Planes, reach: Vector
    ) -> tuple[Numbers, Numbers]:
        """Find the pieces of the master that face those of the slave and may lie over them.

        They are those of chosen pieces (p,) of the slave, which have the planes and reach. Pairs
        (slave, master) are in the order of the slave's pieces; each once.
        """
        x = slave_facets.coordinates(chosen)
        frames = planes.project(np.arange(len(x)), x)
        low, high = lowest(frames), highest(frames)
        low[:, -1] -= reach
        high[:, -1] += reach
        # the box around the facet's prism along its normal
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        # not those that only touch the prism, such as all facets around an edge
        half[:, :-1] *= 1.0 - _SLIVER
        centre = planes.origin + np.einsum("fa,fad->fd", middle, planes.axes)
        extent = np.einsum("fa,fad->fd", half, np.abs(planes.axes))
        contact = slave_facets.apart(slave_facets.pieces[chosen, 0])[:, x.shape[2] :]
        upper, lower = (
            np.hstack([centre + side * extent, contact]).T.copy() for side in (1.0, -1.0)
        )

        def overlaps(row: Numbers, box_low: Vector, box_high: Vector) -> Mask:
            overlapping = np.ones(row.size, dtype=bool)
            for axis, (top, bottom) in enumerate(zip(upper, lower, strict=True)):
                overlapping &= box_low[:, axis] <= top.take(row)
                overlapping &= box_high[:, axis] >= bottom.take(row)
            return overlapping

        slave, master = self._tree.candidates(len(x), overlaps)
        normals = (planes.normal.take(slave, axis=0), self.planes.normal.take(master, axis=0))
        # by more than 96 degrees
        faces = np.einsum("kd,kd->k", *normals) < -0.1
        return slave[faces], master[faces]


@dataclass(frozen=True)
class Cells:
    """Segments or triangles (c,) in the planes of slave facets, of pairs (p,) of facets."""

    slave: Numbers  # slave facet, or piece of one, of each pair (p,), ascending
    master: Numbers  # master facet of each pair (p,)
    on_slave: Vector  # (p, v, gdim - 1): corners in the plane of the slave [m]
    on_master: Vector  # (p, w, gdim - 1): projected corners of the master [m]
    height: Vector  # (p, w): heights of the master's corners above the plane, the gap there [m]
    pair: Numbers  # pair that each cell belongs to (c,)
    corners: Vector  # (c, gdim, gdim - 1): corners of the cells in the plane [m]
    area: Vector  # (c,) [m^2 or m]

    @cached_property
    def pair_area(self) -> Vector:
        """The area of the cells of each pair (p,)."""
        return np.bincount(self.pair, self.area, self.slave.size).astype(np.float64, copy=False)

    @cached_property
    def centre(self) -> tuple[Vector, Vector]:
        """The centroid (p, gdim - 1) of each pair's cells, and the gap (p,) there [m]."""
        weighted = centres(self.corners) * self.area[:, None]
        middle: Vector = np.stack(
            [np.bincount(self.pair, column, self.slave.size) for column in weighted.T], axis=1
        )
        middle = middle / self.pair_area[:, None]
        xi = reference_coordinates(self.on_master, middle[:, None])[:, 0]
        shapes = shape_functions(xi, self.on_master.shape[1])
        return middle, np.einsum("pw,pw->p", shapes, self.height)

    def select_pairs(self, kept: Mask) -> Cells:
        """Leave out pairs."""
        if kept.all():
            return self
        new, chosen = np.cumsum(kept) - 1, kept[self.pair]
        of_pairs = (self.slave, self.master, self.on_slave, self.on_master, self.height)
        of_cells = (new[self.pair], self.corners, self.area)
        columns = [column[kept] for column in of_pairs] + [column[chosen] for column in of_cells]
        return Cells(*columns)


def covering_cells(
    slave: Facets, planes: Planes, chosen: Numbers, master: MasterTree, reach: Vector
) -> Cells:
    """Find the cells of some slave facets, ascending.

    Of several layers of the master the nearest one counts, without steep sides that go back from
    it. Facets behind the slave count only where the slave is inside the master. The areas of a
    facet's cells add up to that of the facet at most, up to rounding. For the reach see
    `MasterTree.reach`.
    """
    cells = overlapping_cells(slave, planes, chosen, master, reach)
    cells = _without_far_sides(slave, cells, planes, master)
    cells = _without_steep_sides(cells, planes, master)
    return nearest_layers(cells, planes, master)


def overlapping_cells(
    slave: Facets, planes: Planes, chosen: Numbers, master: MasterTree, reach: Vector
) -> Cells:
    """Find the cells of some slave facets, ascending, with all layers of the master."""
    x = slave.coordinates(chosen)
    chosen_planes = planes.chosen(chosen)
    row, facet = master.candidates(slave, chosen, chosen_planes, reach[chosen])
    on_slave = chosen_planes.project(np.arange(len(x)), x)[row, :, :-1]
    frames = chosen_planes.project(row, master.facets.coordinates(facet))
    on_master = frames[..., :-1]
    separate = (highest(on_slave) <= lowest(on_master)) | (highest(on_master) <= lowest(on_slave))
    overlapping = ~reduce(np.logical_or, separate.T)
    row, facet, frames = row[overlapping], facet[overlapping], frames[overlapping]
    pair, corners, area = _intersections(on_master[overlapping], on_slave[overlapping])
    cells = Cells(
        chosen[row],
        facet,
        on_slave[overlapping],
        frames[..., :-1],
        frames[..., -1],
        pair,
        corners,
        area,
    )
    return cells.select_pairs(cells.pair_area > _SLIVER * planes.area[cells.slave])


def _intersections(master: Vector, slave: Vector) -> tuple[Numbers, Vector, Vector]:
    """Return the cells of pairs of projected facets: the pair, the corners and the area of each."""
    if master.shape[2] == 1:
        ends = clip_intervals(master[..., 0], slave[..., 0])
        return np.arange(len(ends)), ends[:, :, None], ends[:, 1] - ends[:, 0]
    # facets that face the slave are clockwise in its plane
    return fan_triangles(*clip_polygons(master[:, ::-1], slave))


def _without_far_sides(slave: Facets, cells: Cells, planes: Planes, master: MasterTree) -> Cells:
    """Leave out master facets far behind the slave unless the slave is inside the master there.

    Those deeper behind a facet than its `depth` are of the other side of its own wall.
    """
    if slave.depth is not None:
        limit = slave.depth[cells.slave // slave.per_facet]
        cells = cells.select_pairs(cells.centre[1] >= -limit)
    size = np.maximum(planes.diameter[cells.slave], master.planes.diameter[cells.master])
    if (cells.height >= -size[:, None]).all():
        return cells
    suspects = np.flatnonzero(cells.centre[1] < -size)
    if not suspects.size:
        return cells
    facets = master.facets
    of_points = facets.contact_of(facets.pieces[cells.master[suspects], 0])
    of_facets = facets.contact_of(facets.nodes[:, 0])
    kept = np.ones(cells.slave.size, dtype=bool)
    kept[suspects] = are_nearest(cells, suspects, planes, of_points, facets, of_facets)
    return cells.select_pairs(kept)


def _without_steep_sides(cells: Cells, planes: Planes, master: MasterTree) -> Cells:
    """Leave out steep facets of the master that are not nearer to a slave facet than others.

    They are inclined to the slave by more than 60 degrees, such as the side of a box whose end it
    touches: where the gap grows that fast beside an edge, its mean is that at no place, and may be
    negative. Those of a sharp wedge, which nothing else is nearer than, count.
    """
    normals = planes.normal[cells.slave], master.planes.normal[cells.master]
    steep = -np.einsum("pd,pd->p", *normals) < (1.0 - RELATIVE_ROUNDING) / REACH
    if not steep.any():
        return cells
    xi = reference_coordinates(cells.on_master[cells.pair], cells.corners)
    shapes = shape_functions(xi, cells.on_master.shape[1])
    gaps = lowest(np.einsum("cqw,cw->cq", shapes, cells.height[cells.pair])[:, :, None])[:, 0]
    least = np.full(cells.slave.size, np.inf)
    np.minimum.at(least, cells.pair, gaps)
    nearest = np.full(len(planes.area), np.inf)
    np.minimum.at(nearest, cells.slave[~steep], least[~steep])
    rounding = RELATIVE_ROUNDING * planes.diameter[cells.slave]
    return cells.select_pairs(~steep | (least < nearest[cells.slave] - rounding))


def are_nearest(
    cells: Cells, pairs: Numbers, planes: Planes, of_pairs: Numbers, facets: Facets, of: Numbers
) -> Mask:
    """Tell for which pairs (k,), facets behind the slave's, the slave has come in through them.

    The slave is inside the facets (f,) whose number `of` is that of the pair, and not farther from
    the pair's than they are inclined: other facets are nearer where the two are back to back.
    """
    middle, gap = (of_cells[pairs] for of_cells in cells.centre)
    facet, depth = cells.slave[pairs], np.zeros(pairs.size)
    x = planes.origin[facet] + np.einsum("pa,pad->pd", middle, planes.axes[facet, :-1])
    for number in np.unique(of_pairs):
        chosen = of_pairs == number
        surface = FacetedSurface.of(Facets(facets.points, facets.nodes[of == number]))
        depth[chosen] = -surface.distance(x[chosen]).signed
    return (depth > 0.0) & (-gap <= REACH * depth)


def nearest_layers(cells: Cells, planes: Planes, master: MasterTree) -> Cells:
    """Keep the nearest layer, connected through nodes of the master, over each slave facet."""
    area, limit = cells.pair_area, (1.0 + 1e-6) * planes.area
    several = np.bincount(cells.slave, area, len(limit)) > limit
    pairs = np.flatnonzero(several[cells.slave])
    if not pairs.size:
        return cells
    gap = np.abs(cells.centre[1])
    kept = np.ones(cells.slave.size, dtype=bool)
    facet, area = cells.slave[pairs], area[pairs]
    corners = master.facets.pieces[cells.master[pairs]]
    # nodes are distinct for each slave facet
    keys = facet[:, None] * len(master.facets.points) + corners
    _, node = np.unique(keys, return_inverse=True)
    row = np.repeat(np.arange(pairs.size), corners.shape[1])
    incidence = sp.csr_matrix((np.ones(row.size), (row, node.ravel())))
    _, layer = connected_components(incidence @ incidence.T, directed=False)
    layer_area = np.bincount(layer, area)
    distance = np.bincount(layer, area * gap[pairs]) / layer_area
    facet_of_layer = np.zeros(layer_area.size, dtype=np.int64)
    facet_of_layer[layer] = facet
    # layers beside each other, such as parts of the master with a slot between them, all count
    order = np.lexsort((distance, facet_of_layer))
    selected = np.zeros(layer_area.size, dtype=bool)
    filled = np.zeros(len(planes.area))
    for number in order:
        slave, covered = facet_of_layer[number], layer_area[number]
        if filled[slave] == 0.0 or filled[slave] + covered <= limit[slave]:
            selected[number] = True
            filled[slave] += covered
    kept[pairs] = selected[layer]
    return cells.select_pairs(kept)
