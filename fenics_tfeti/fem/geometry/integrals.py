"""Integrals of the shape functions of two surfaces over the covered part of each slave facet."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.geometry.cells import Cells, MasterTree, covering_cells
from fenics_tfeti.fem.geometry.clipping import fan_triangles
from fenics_tfeti.fem.geometry.facets import (
    Facets,
    Planes,
    corner_functions,
    reference_coordinates,
    shape_functions,
)
from fenics_tfeti.fem.geometry.reference_cells import quadrature
from fenics_tfeti.fem.geometry.rims import rim_functions
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.typing import Numbers, Vector


@dataclass(frozen=True)
class FacetIntegrals:
    """Integrals over the covered part of c slave facets, with the weight of the measure.

    N are the shape functions of degree 1 of a slave facet with v corners; N^s and N^m are those of
    the displacement on a slave facet with t nodes and on a master facet with w nodes over it. Of
    degree 2 a pair of facets is there once for each pair of their pieces.
    """

    facet: Numbers  # slave facets that are covered (c,), ascending
    covered: Vector  # (c,): covered area in the plane, without weight [m^2 or m]
    share: Vector  # (c, v): of N_j, without weight [m^2 or m]
    ones: Vector  # (c, v): of N_j
    mass: Vector  # (c, v, v): of N_i N_j
    trace: Vector  # (c, v, t): of N_i N^s_j; for degree 1 the same as mass
    gap: Vector  # (c, v, gdim): of N_j times the vector from the slave to the master
    pair: Numbers  # (p,): row of each pair of a slave and a master facet
    master: Numbers  # (p,): master facet of each pair
    coupling: Vector  # (p, v, w): of N_i N^m_l
    # (c, v, v): N_i at corner j of the smallest facet around the covered part, see `rim_functions`
    rim: Vector


def integrate(slave: Facets, master: Facets, weight: Vector | None = None) -> FacetIntegrals:
    """Integrate over the parts of the slave's facets that the master covers.

    Points of the two surfaces are opposite each other along the normal of the slave's facet. The
    quadrature is exact for segments, triangles and parallelograms, also of degree 2 if these are
    straight, with their nodes in the middle of the edges. Its error on other quadrilaterals is
    about 1e-8 if they are distorted as much as meshes allow. Whatever the error, the integrals of a
    facet are of the same points: constants and, on flat surfaces, linear functions are reproduced.
    The weight (f, v), by default 1, is linear between the corners of the slave's facets.
    """
    planes, tree = slave.planes, MasterTree(master)
    reach, parts = tree.reach(slave, planes), []
    count = len(slave.pieces) if len(master) else 0
    # to bound the memory; all 1, 2 or 4 pieces of a facet are in the same block
    for block in batches(max(count, 1), 2048):
        chosen = np.arange(block.start, min(block.stop, count))
        cells = covering_cells(slave, planes, chosen, tree, reach)
        parts.append(_integrate_cells(cells, slave, planes, master, weight))
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0, *(part.facet.size for part in parts)])
    columns: dict[str, Any] = {
        column.name: np.concatenate([getattr(part, column.name) for part in parts])
        for column in fields(FacetIntegrals)
    }
    columns["pair"] += np.repeat(first[:-1], [part.pair.size for part in parts])
    return FacetIntegrals(**columns)


def integrate_alone(slave: Facets, weight: Vector | None = None) -> FacetIntegrals:
    """Integrate over whole facets, without a master: the surface takes its place."""
    x = slave.coordinates()
    planes, piece = slave.planes, np.arange(len(x))
    flat = planes.project(piece, x)[..., :-1]
    if flat.shape[2] == 1:
        pair, corners, area = piece, flat, planes.area
    else:
        pair, corners, area = fan_triangles(flat, np.full(len(flat), flat.shape[1]))
    height = np.zeros(flat.shape[:2])
    cells = Cells(piece, piece, flat, flat, height, pair, corners, area)
    return _integrate_cells(cells, slave, planes, slave, weight)


def _integrate_cells(
    cells: Cells, slave: Facets, planes: Planes, master: Facets, weight: Vector | None
) -> FacetIntegrals:
    slave_facet = cells.slave // slave.per_facet
    covered = np.bincount(slave_facet, cells.pair_area, len(slave))[slave_facet]
    rounding = 1e-11 * slave.areas[slave_facet]
    cells = cells.select_pairs(covered > rounding)
    slave_facet, master_facet = cells.slave // slave.per_facet, cells.master // master.per_facet
    facet, pair = np.unique(slave_facet, return_inverse=True)
    t, w = slave.nodes.shape[1], master.nodes.shape[1]
    places, factors = _quadrature(cells, weight is None, max(slave.per_facet, master.per_facet))
    cell_pair = cells.pair
    x = places @ cells.corners
    on_slave, on_master = (
        surface.in_facet(piece[cell_pair], reference_coordinates(corners[cell_pair], x))
        for surface, piece, corners in (
            (slave, cells.slave, cells.on_slave),
            (master, cells.master, cells.on_master),
        )
    )
    slave_functions, master_functions = corner_functions(on_slave, t), shape_functions(on_master, w)
    cell_facet = pair[cell_pair]
    of_facet, pairs_of_facet = (_first(index, facet.size) for index in (cell_facet, pair))
    weights = cells.area[:, None, None] * factors[:, None]
    weighted = slave_functions * weights
    ones = share = _sum(weighted.sum(axis=1), of_facet)
    if weight is not None:
        factor = np.einsum("cqi,ci->cq", slave_functions, weight[slave_facet[cell_pair]])
        weighted *= factor[:, :, None]
        ones = _sum(weighted.sum(axis=1), of_facet)
    rows = weighted.swapaxes(1, 2)
    mass = trace = _sum(rows @ slave_functions, of_facet)
    if slave.per_facet > 1:
        trace = _sum(rows @ shape_functions(on_slave, t), of_facet)
    coupling = _sum(rows @ master_functions, _first(cell_pair, cells.slave.size))
    # relative to a plane's origin: rounding is that of the gap, not that of the coordinates
    origin = planes.origin[facet * slave.per_facet, None]
    offset = master.points.take(master.nodes[master_facet], axis=0) - origin[pair]
    gap = _sum(np.matmul(coupling, offset), pairs_of_facet)
    gap -= np.matmul(trace, slave.points.take(slave.nodes[facet], axis=0) - origin)
    corners = reference_coordinates(cells.on_slave[cell_pair], cells.corners)
    corners = slave.in_facet(cells.slave[cell_pair], corners)
    return FacetIntegrals(
        facet,
        _sum(cells.pair_area, pairs_of_facet),
        share,
        ones,
        mass,
        trace,
        gap,
        pair,
        master_facet,
        coupling,
        rim_functions(corners, cell_facet, ones),
    )


def _quadrature(cells: Cells, unweighted: bool, pieces: int) -> tuple[Vector, Vector]:
    """Return barycentric coordinates (q, gdim) and weights (q,) whose sum is 1."""
    triangles = cells.on_slave.shape[1] == cells.on_master.shape[1] == 3
    # with several pieces of a facet the shape functions are of degree 2
    quadratic = pieces > 1 and not triangles
    if cells.corners.shape[2] == 1:
        points, weights = quadrature("interval", 3 if pieces == 1 else 5)
    elif unweighted and triangles and pieces == 1:
        points, weights = quadrature("triangle", 2)
    elif quadratic or _distorted(cells.on_slave) or _distorted(cells.on_master):
        # shape functions that are rational
        points, weights = quadrature("triangle", 8)
    else:
        points, weights = quadrature("triangle", 4)
    return np.column_stack([1.0 - points.sum(axis=1), points]), weights / weights.sum()


def _distorted(corners: Vector) -> bool:
    """Tell whether some facets are quadrilaterals whose shape functions are not polynomials."""
    if corners.shape[1] < 4:
        return False
    skew = corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]
    size = np.abs(corners).max(initial=0.0)
    return bool(np.abs(skew).max(initial=0.0) > RELATIVE_ROUNDING * size)


def _first(index: Numbers, size: int) -> Numbers:
    """Return the first row of each number (size,); the numbers of rows ascend, each has one."""
    return np.searchsorted(index, np.arange(size))


def _sum(values: Vector, first: Numbers) -> Vector:
    """Sum rows from each first one up to the next."""
    if not first.size:
        return np.zeros((0, *values.shape[1:]))
    # along the last axis, which is contiguous; the result in the order of rows
    last = values.ndim - 1
    total = np.add.reduceat(values.transpose(*range(1, last + 1), 0), first, axis=-1)
    return np.ascontiguousarray(total.transpose(last, *range(last)))
