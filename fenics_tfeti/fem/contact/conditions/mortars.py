"""Mortar conditions of a contact, distributed: rows at the ranks that own the slave's nodes.

Each rank integrates over the slave's facets that it owns, with what of the master's surface is near
them. The contributions of the facets are summed at the owners of the slave's nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.contact.conditions.contact_conditions import (
    Accuracy,
    Conditions,
    PressureShares,
    Terms,
)
from fenics_tfeti.fem.contact.conditions.mortar_matrices import (
    BARELY_COVERED,
    BARELY_SUPPORTED,
    HARDLY_SUPPORTED,
    Entries,
    coverage_and_support,
    covered_shares,
    mortar_matrices,
    multiplier_shares,
    node_sums,
)
from fenics_tfeti.fem.contact.surfaces.normals import normals_in_symmetry_planes
from fenics_tfeti.fem.contact.surfaces.surface_facets import SurfaceFacets
from fenics_tfeti.fem.contact.surfaces.tagged import Surface
from fenics_tfeti.fem.geometry.facets import Facets, Planes
from fenics_tfeti.fem.geometry.integrals import FacetIntegrals, integrate, integrate_alone
from fenics_tfeti.fem.geometry.normals import chord_heights
from fenics_tfeti.fem.geometry.vectors import angles_between, unit
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.feti.system import sum_by_row
from fenics_tfeti.parallel import any_rank, concatenate_buffers, positions
from fenics_tfeti.typing import Mask, Numbers, Vector


@dataclass(frozen=True)
class NodesWithoutConditions:
    """Where supports, and nodes of both surfaces, leave a slave no conditions, wherever it is."""

    prescribed: Mask  # (k, gdim): components prescribed at the surface's nodes of this rank
    anywhere: bool  # whether a component is prescribed on any rank
    # at the nodes of the surface's `part` (n, ...)
    held: Mask  # (n, gdim): see `_held_by_supports`
    shared: Mask  # (n,): nodes of both surfaces

    @staticmethod
    def of(surface: Surface, shared: Numbers, prescribed: Mask) -> NodesWithoutConditions:
        """Find them with the nodes (s,) of both surfaces, of all ranks. Collective."""
        slave = surface.part()
        return NodesWithoutConditions(
            prescribed,
            any_rank(surface.comm, prescribed),
            _held_by_supports(surface, slave, prescribed),
            np.isin(slave.nodes, shared),
        )


def mortar_conditions(
    surface: Surface,
    master: SurfaceFacets,
    without: NodesWithoutConditions,
    before: Numbers,
    has_user_normals: bool,
) -> Conditions:
    """Integrate over the slave's facets and sum up at the owners of its nodes. Collective.

    The slave's facets are those of this rank, of the master those near them. Normals are those of
    the facets that are covered, if not the user's. No condition have nodes of both surfaces, and
    those that their supports hold along the normal. Nodes of this rank that had conditions `before`
    keep them longer than others.
    """
    slave = surface.oriented_part()
    integrals = integrate(slave.facets, master.facets, slave.corner_weight)
    if not has_user_normals:
        surface = surface.with_normals_of(covered_shares(slave.facets, integrals))
        if without.anywhere:
            normal = normals_in_symmetry_planes(surface, without.prescribed)
            surface = replace(surface, normal=normal)
        slave = replace(slave, vertex_normals=surface.normals_at(slave.nodes))
    along = np.abs(slave.normal) > RELATIVE_ROUNDING
    free = (without.held | ~along).all(axis=1) | without.shared
    return _conditions(surface, slave, master, integrals, free, before)


def tied_conditions(
    surface: Surface, slave: SurfaceFacets, master: SurfaceFacets, prescribed: Mask
) -> list[Conditions]:
    """Return conditions for each component of surfaces that stay together. Collective."""
    integrals = integrate(slave.facets, master.facets, slave.corner_weight)
    free = _held_by_supports(surface, slave, prescribed)
    # of degree 2 the solution is more exact with the shape functions as multipliers
    dual = slave.facets.per_facet == 1
    none = np.zeros(0, dtype=np.int64)
    return [_conditions(surface, slave, master, integrals, held, none, dual) for held in free.T]


def _held_by_supports(surface: Surface, slave: SurfaceFacets, prescribed: Mask) -> Mask:
    """Tell at which of the slave's nodes (n,) a support makes a condition useless. Collective.

    The result (n, gdim) is by components, as `prescribed` (k, gdim) at the surface's nodes of this
    rank. Where a component is prescribed at a node, but not at all nodes of a facet, a condition
    would hold the master more than the support does; if the master is held there, too, its force
    would have to act through what little of the master is free, and be as much larger.
    """
    gdim, fixed = prescribed.shape[1], surface.at_corners(prescribed)
    all_fixed = np.broadcast_to(fixed.all(axis=1, keepdims=True), fixed.shape)
    flags = np.concatenate([all_fixed, fixed], axis=2).reshape(-1, 2 * gdim)
    nodes, corners = surface.boundary.nodes, slave.nodes[slave.facets.corners.ravel()]
    flags = nodes.values_at(nodes.reduce_at_owners(corners, flags, np.logical_or), slave.nodes)
    return ~flags[:, :gdim] & flags[:, gdim:]


def one_sided_conditions(surface: Surface, slave: SurfaceFacets, chosen: Mask) -> Terms:
    """Integrate over chosen facets (f,) of the slave alone, at a rigid obstacle. Collective.

    A uniform pressure on a quadratic triangle gives no force at its vertices: conditions node by
    node would not balance it. As between two surfaces, the multipliers are those of dual functions
    at the vertices; the master's part is missing. Returned are the terms by ascending slave node.
    """
    facets = Facets(slave.points, slave.facets.nodes[chosen])
    weight = None if slave.weight is None else slave.weight[facets.corners]
    D = mortar_matrices(integrate_alone(facets, weight), facets, facets).D
    row, column = slave.nodes[D.row], slave.nodes[D.column]
    all_nodes, on_slave = surface.boundary.nodes, np.ones(D.value.size, dtype=bool)
    return collect_terms(all_nodes, row, column, D.value, on_slave)


def _conditions(
    surface: Surface,
    slave: SurfaceFacets,
    master: SurfaceFacets,
    integrals: FacetIntegrals,
    free: Mask,
    before: Numbers,
    dual: bool = True,
) -> Conditions:
    """Sum up the conditions at the owners of their nodes, none at free ones. Collective."""
    matrices = mortar_matrices(integrals, slave.facets, master.facets, dual)
    all_nodes = surface.boundary.nodes
    sums = all_nodes.reduce_at_owners(slave.nodes, node_sums(integrals, slave.facets))
    coverage, support = coverage_and_support(all_nodes.values_at(sums, slave.nodes))
    limits = np.full(all_nodes.owned, BARELY_SUPPORTED)
    limits[before - all_nodes.first] = HARDLY_SUPPORTED
    least = all_nodes.values_at(limits, slave.nodes)
    corners = slave.nodes[slave.facets.corners[integrals.facet]]
    nodes, S = _shares(all_nodes, corners, slave.nodes, support, least, free, slave.nodes)
    D, M = matrices.D, matrices.M
    # at a rim the row's normal is that of the place that the row speaks of
    corner_normals = slave.from_corners(slave.normal)
    normal = sum_by_row(D.row, D.value[:, None] * corner_normals[D.column], D.shape[0])
    integrated = np.column_stack([normal, matrices.gap, matrices.area])
    if S is not None:
        D, M = (Entries.of(S @ part.matrix()) for part in (D, M))
        integrated = S @ integrated
    terms = collect_terms(
        all_nodes,
        nodes[np.concatenate([D.row, M.row])],
        np.concatenate([slave.nodes[D.column], master.nodes[M.column]]),
        np.concatenate([D.value, -M.value]),
        np.repeat([True, False], [D.value.size, M.value.size]),
    )
    own = terms.slave - all_nodes.first
    means = all_nodes.reduce_at_owners(nodes, integrated)[own]
    gdim = normal.shape[1]
    normal, gap, area = means[:, :gdim], means[:, gdim : 2 * gdim], means[:, 2 * gdim :]
    facets = np.zeros(len(slave.facets), dtype=bool)
    facets[integrals.facet] = True
    shares = partial(_pressure_shares, all_nodes, corners, slave.nodes, coverage, terms.slave)
    return Conditions(
        terms,
        unit(normal),
        gap / area,
        area[:, 0],
        coverage_and_support(sums[own])[0],
        facets,
        partial(_accuracy, surface, slave, master, integrals, own),
        PressureShares(shares),
    )


def _accuracy(
    surface: Surface,
    slave: SurfaceFacets,
    master: SurfaceFacets,
    integrals: FacetIntegrals,
    own: Numbers,
) -> Accuracy:
    """Measure how well conditions at own nodes (k,) fit their surfaces. Collective."""
    corners = slave.nodes[slave.facets.corners[integrals.facet]].ravel()
    largest = _largest_of_facets(slave, master, integrals)
    sums = surface.boundary.nodes.reduce_at_owners(corners, largest, np.maximum)
    chord, deviation, angle = sums[own].T
    contact = surface.facet_contact[integrals.facet]
    covered = np.bincount(contact, integrals.covered, len(surface.extent))
    return Accuracy(chord, angle, covered, deviation)


def _pressure_shares(
    all_nodes: NodeMap, corners: Numbers, nodes: Numbers, coverage: Vector, of: Numbers
) -> sp.csr_matrix:
    """Return the shares (k, N) of all nodes in conditions of nodes (k,), by coverage. Collective.

    They are for `mean_traction`; the other arguments are as in `_shares`.
    """
    least, free = np.full(nodes.size, BARELY_COVERED), np.zeros(nodes.size, dtype=bool)
    taking, S = _shares(all_nodes, corners, nodes, coverage, least, free, of)
    if S is None:
        S = sp.identity(of.size, format="csr")
    entries = S.T.tocsr()
    columns = taking[entries.indices]
    return sp.csr_matrix((entries.data, columns, entries.indptr), (of.size, all_nodes.total))


def _shares(
    all_nodes: NodeMap,
    corners: Numbers,
    nodes: Numbers,
    support: Vector,
    least: Vector,
    free: Mask,
    of: Numbers,
) -> tuple[Numbers, sp.csr_matrix | None]:
    """Return nodes (r,) and their `multiplier_shares` (r, q) in functions `of` nodes. Collective.

    The shares are None where all nodes keep their functions.

    This rank's covered facets have the corners (c, v); the values (n,) are at the slave's nodes
    around its facets, alike on all ranks. All nodes have global numbers.
    """
    ends = np.array(list(permutations(range(corners.shape[1]), 2)))
    j, k = (np.searchsorted(nodes, corners[:, side].ravel()) for side in ends.T)
    excluded = free[j] | (support[j] < least[j])
    j, k = j[excluded], k[excluded]
    # each pair with the values of its nodes, which are alike on all ranks
    columns = concatenate_buffers(
        all_nodes.comm,
        *(column[rows] for column in (nodes, support, least, free) for rows in (j, k)),
    )
    if not columns[0].size:
        return of, None
    at_ends, support, least, free = (np.concatenate(columns[k : k + 2]) for k in range(0, 8, 2))
    # on all ranks those without a multiplier and their neighbours
    sharing, first, inverse = np.unique(at_ends, return_index=True, return_inverse=True)
    pairs = inverse.reshape(2, -1).T
    given = multiplier_shares(support[first], least[first], free[first], pairs)
    place = positions(sharing, of)
    alone, shared = np.flatnonzero(place < 0), np.flatnonzero(place >= 0)
    part = given[:, place[shared]].tocoo()
    taking, row = np.unique(part.row, return_inverse=True)
    row = np.concatenate([np.arange(alone.size), alone.size + row])
    column = np.concatenate([alone, shared[part.col]])
    values = np.concatenate([np.ones(alone.size), part.data])
    shares = sp.csr_matrix((values, (row, column)), (alone.size + taking.size, of.size))
    return np.concatenate([of[alone], sharing[taking]]), shares


def collect_terms(
    all_nodes: NodeMap, row: Numbers, column: Numbers, value: Vector, on_slave: Mask
) -> Terms:
    """Sum up terms (t,) at the owners of their rows; conditions by ascending node. Collective.

    `row` and `column` are global nodes: the slave node of the condition, and the node of the term,
    which `on_slave` says to be one of the slave. Values are negative on the master [m^2 or m]. A
    node on both surfaces, as the tip of a crack, has two terms: the weights of the slave's add up
    to the area.
    """
    row, column, value, on_slave = all_nodes.to_owners(row, column, value, on_slave)
    row = row + all_nodes.first
    # values in ascending order: the sum does not depend on the order in which they arrive
    order = np.lexsort((value, on_slave, column, row))
    row, column, value, on_slave = row[order], column[order], value[order], on_slave[order]
    changes = (np.diff(key, prepend=-1).astype(bool) for key in (row, column, on_slave.astype(int)))
    first = np.flatnonzero(np.logical_or.reduce(list(changes)))
    if first.size:
        value = np.add.reduceat(value, first)
    row, column, on_slave = row[first], column[first], on_slave[first]
    # the node of the condition, other nodes of the slave, nodes of the master
    order = np.lexsort((column, column != row, ~on_slave, row))
    nodes, condition = np.unique(row[order], return_inverse=True)
    number = np.bincount(condition, minlength=nodes.size)
    slaves = np.bincount(condition[on_slave[order]], minlength=nodes.size).astype(np.int64)
    offsets = np.append(0, np.cumsum(number)).astype(np.int64)
    return Terms(offsets, column[order], value[order], slaves)


def _largest_of_facets(
    slave: SurfaceFacets, master: SurfaceFacets, integrals: FacetIntegrals
) -> Vector:
    """Return chords, deviations and angles (p, 3) at each corner of the covered facets."""
    facet, opposite_facet = integrals.facet[integrals.pair], integrals.master
    planes, opposite = (
        Planes.of(surface.points[surface.facets.corners]) for surface in (slave, master)
    )
    angle = angles_between(planes.normal[facet], -opposite.normal[opposite_facet])
    largest = np.zeros((len(slave.facets), 3))
    np.maximum.at(largest, facet, np.column_stack([_heights(master)[opposite_facet], angle]))
    largest[:, :2] += _heights(slave)
    return np.repeat(largest[integrals.facet], slave.facets.number_of_corners, axis=0)


def _heights(surface: SurfaceFacets) -> Vector:
    """Return the chords and deviations (f, 2) of facets from the surface with their normals."""
    corners, nodes = surface.facets.corners, surface.facets.nodes
    middles = nodes[:, corners.shape[1] :]
    points = surface.points[middles] if middles.size else None
    heights = chord_heights(surface.points[corners], surface.normal[corners], points)
    return np.column_stack(heights)
