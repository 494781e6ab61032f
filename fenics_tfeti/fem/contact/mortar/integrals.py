"""Integrals of the shape functions of two surfaces over the covered part of each slave facet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fenics_tfeti.fem.contact.mortar.candidates import MasterTree
from fenics_tfeti.fem.contact.mortar.cells import Cells, covering_cells
from fenics_tfeti.fem.contact.mortar.facets import (
    Facets,
    Planes,
    by_component,
    reference_coordinates,
    shape_functions,
)
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING

__all__ = ["FacetIntegrals", "integrate"]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Covered part of a slave facet, relative to its area, below which it is rounding.
_NOT_COVERED = 1e-10

# Slave facets that are treated at once, to bound the memory.
_BLOCK = 2048


@dataclass(frozen=True)
class FacetIntegrals:
    """Integrals over the covered part of slave facets, with the weight of the measure.

    N are the shape functions of a slave facet, N^m those of a master facet over it.

    Attributes
    ----------
    facet : (c,) integer array
        The slave facets that are covered, ascending.
    covered : (c,) array
        Covered area of each, in its plane and without weight [m^2 or m].
    share : (c, v) array
        Integrals of N_j without weight [m^2 or m].
    ones : (c, v) array
        Integrals of N_j.
    mass : (c, v, v) array
        Integrals of N_i N_j.
    gap : (c, v, gdim) array
        Integrals of N_j times the vector from the slave to the master.
    pair : (p,) integer array
        Position in `facet` of each pair of a slave and a master facet.
    master : (p,) integer array
        The master facets.
    coupling : (p, v, w) array
        Integrals of N_j N^m_l.
    """

    facet: Numbers
    covered: Vector
    share: Vector
    ones: Vector
    mass: Vector
    gap: Vector
    pair: Numbers
    master: Numbers
    coupling: Vector


def integrate(
    slave: Facets, master: Facets, weight: NDArray[np.float64] | None = None
) -> FacetIntegrals:
    """Integrate over the parts of the slave's facets that the master covers.

    Points of the two surfaces are opposite each other along the normal of the slave's facet. The
    quadrature is exact for segments, triangles and parallelograms. Its error on other
    quadrilaterals is about 1e-8 if they are distorted as much as meshes allow. Whatever the error,
    the integrals of a facet are of the same points: constants and, on flat surfaces, linear
    functions are reproduced.

    Parameters
    ----------
    slave, master : Facets
        The two surfaces, each of facets of one type.
    weight : (f, v) array, optional
        Weight of the measure at the corners of the slave's facets, linear between them; by default
        1.

    Returns
    -------
    FacetIntegrals
        Without facets where the surfaces do not lie over each other.
    """
    v, w, gdim = slave.corners.shape[1], master.corners.shape[1], slave.points.shape[1]
    parts = [_no_integrals(v, w, gdim)]
    if len(slave) and len(master):
        planes, tree = Planes.of(slave.coordinates()), MasterTree(master)
        reach = tree.reach(slave, planes)
        for first in range(0, len(slave), _BLOCK):
            chosen = np.arange(first, min(first + _BLOCK, len(slave)))
            cells = covering_cells(slave, planes, chosen, tree, reach)
            parts.append(_integrate_cells(cells, slave, planes, master, weight))
    return _join(parts)


def _join(parts: Sequence[FacetIntegrals]) -> FacetIntegrals:
    """Return the integrals of all parts, one part after the other."""
    first = np.cumsum([0, *(part.facet.size for part in parts)])
    columns: dict[str, Any] = {
        column.name: np.concatenate([getattr(part, column.name) for part in parts])
        for column in fields(FacetIntegrals)
    }
    columns["pair"] += np.repeat(first[:-1], [part.pair.size for part in parts])
    return FacetIntegrals(**columns)


def _no_integrals(v: int, w: int, gdim: int) -> FacetIntegrals:
    numbers, values = np.zeros(0, dtype=np.int64), np.zeros(0)
    return FacetIntegrals(
        numbers,
        values,
        np.zeros((0, v)),
        np.zeros((0, v)),
        np.zeros((0, v, v)),
        np.zeros((0, v, gdim)),
        numbers,
        numbers,
        np.zeros((0, v, w)),
    )


def _integrate_cells(
    cells: Cells, slave: Facets, planes: Planes, master: Facets, weight: Vector | None
) -> FacetIntegrals:
    area = np.bincount(cells.slave, cells.pair_area(), len(slave))
    cells = cells.of_pairs(area[cells.slave] > _NOT_COVERED * planes.area[cells.slave])
    facet, pair = np.unique(cells.slave, return_inverse=True)
    places, factors = _quadrature(cells, weight is None)
    at = cells.pair
    x = by_component([part @ places.T for part in np.moveaxis(cells.corners, 2, 0)])
    ours, theirs = (
        shape_functions(reference_coordinates(_rows(facets, at), x), facets.shape[1])
        for facets in (cells.on_slave, cells.on_master)
    )
    of_facet = pair[at]
    weights = cells.area[:, None, None] * factors[:, None]
    weighted = ours * weights
    ones = share = _sum(weighted.sum(axis=1), of_facet, facet.size)
    if weight is not None:
        weighted *= np.einsum("cqi,ci->cq", ours, weight[cells.slave[at]])[:, :, None]
        ones = _sum(weighted.sum(axis=1), of_facet, facet.size)
    mass = _sum(_products(weighted, ours), of_facet, facet.size)
    coupling = _sum(_products(weighted, theirs), at, cells.slave.size)
    # relative to the plane's origin: rounding is that of the gap, not that of the coordinates
    origin = planes.origin[facet, None]
    to_master = master.coordinates(cells.master) - origin[pair]
    gap = _sum(np.matmul(coupling, to_master), pair, facet.size)
    gap -= np.matmul(mass, slave.coordinates(facet) - origin)
    covered = _sum(cells.pair_area(), pair, facet.size)
    return FacetIntegrals(
        facet,
        covered,
        share,
        ones,
        mass,
        gap,
        pair,
        cells.master,
        coupling,
    )


def _rows(values: Vector, chosen: Numbers) -> Vector:
    """Return rows of an array, in the memory as `by_component` has them."""
    return values.T.take(chosen, axis=-1).T


def _products(one: Vector, other: Vector) -> Vector:
    """Return the sums over q of one_i other_j: (c, q, v) and (c, q, w) to (c, v, w).

    For all cells together: products of many small matrices take several times as long.
    """
    lefts, rights = np.moveaxis(one, 2, 0), np.moveaxis(other, 2, 0)
    rows = [by_component([np.sum(left.T * right.T, axis=0) for right in rights]) for left in lefts]
    return np.stack([row.T for row in rows]).transpose(2, 0, 1)


def _quadrature(cells: Cells, unweighted: bool) -> tuple[Vector, Vector]:
    """Return barycentric coordinates (q, gdim) and weights (q,) whose sum is 1."""
    dim = cells.corners.shape[2]
    if dim == 1:
        root = np.sqrt(1.0 / 12.0)
        return np.array([[0.5 + root, 0.5 - root], [0.5 - root, 0.5 + root]]), np.full(2, 0.5)
    if unweighted and cells.on_slave.shape[1] == cells.on_master.shape[1] == 3:
        return _symmetric((1.0 / 6.0,)), np.full(3, 1.0 / 3.0)
    if _distorted(cells.on_slave) or _distorted(cells.on_master):
        return _degree_eight()
    # Strang and Fix, degree 4
    near, far = 0.445948490915964886, 0.0915762135097707435
    of_near, of_far = 0.223381589678011466, 0.109951743655321868
    return _symmetric((near, far)), np.repeat([of_near, of_far], 3)


def _distorted(corners: Vector) -> bool:
    """Tell whether some facets are quadrilaterals whose shape functions are not polynomials."""
    if corners.shape[1] < 4:
        return False
    skew = corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]
    size = np.abs(corners).max(initial=0.0)
    return bool(np.abs(skew).max(initial=0.0) > RELATIVE_ROUNDING * size)


def _degree_eight() -> tuple[Vector, Vector]:
    """Return the 16 points of degree 8 of Dunavant (1985), for rational functions."""
    places = (0.459292588292723156, 0.170569307751760207, 0.0505472283170309754)
    weights = (0.0950916342672846247, 0.103217370534718250, 0.0324584976231980803)
    one, other = 0.00839477740995760533, 0.263112829634638113
    third = 1.0 - one - other
    skew = np.array(list(permutations((one, other, third))))
    points = [np.full((1, 3), 1.0 / 3.0), _symmetric(places), skew]
    factors = [
        np.array([0.144315607677787168]),
        np.repeat(weights, 3),
        np.full(6, 0.0272303141744349943),
    ]
    return np.concatenate(points), np.concatenate(factors)


def _symmetric(ends: tuple[float, ...]) -> Vector:
    """Return for each number a the points (1 - 2a, a, a) and their permutations."""
    return np.concatenate([np.full((3, 3), a) + (1.0 - 3.0 * a) * np.eye(3) for a in ends])


def _sum(values: Vector, at: Numbers, size: int) -> Vector:
    """Sum rows by the ascending number that each belongs to; every number has a row."""
    if not size:
        return np.zeros((0, *values.shape[1:]))
    first = np.searchsorted(at, np.arange(size))
    # along the last axis, which is contiguous; the result in the order of rows
    total = np.add.reduceat(np.moveaxis(values, 0, -1), first, axis=-1)
    return np.ascontiguousarray(np.moveaxis(total, -1, 0))
