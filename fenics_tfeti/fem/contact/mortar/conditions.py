"""Mortar conditions of a contact, distributed: rows at the ranks that own the slave's nodes.

Each rank integrates over the slave's facets that it owns, with what of the master's surface is near
them. The contributions of the facets are summed at the owners of the slave's nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx.fem import FunctionSpace

from fenics_tfeti.fem.contact.contact import MortarTerms
from fenics_tfeti.fem.contact.mortar.facets import Facets, Planes
from fenics_tfeti.fem.contact.mortar.integrals import FacetIntegrals, integrate
from fenics_tfeti.fem.contact.mortar.matrices import (
    HARDLY_COVERED,
    mortar_matrices,
    node_areas,
)
from fenics_tfeti.fem.contact.pairing_summary import angles_between
from fenics_tfeti.fem.contact.surfaces.deformed import DeformedSurface
from fenics_tfeti.fem.contact.surfaces.initial_gap import chord_heights
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, values_on_facets
from fenics_tfeti.parallel import Directory

__all__ = [
    "MortarConditions",
    "SlaveFacets",
    "collect_terms",
    "mortar_conditions",
    "tied_conditions",
]

Vector = NDArray[np.float64]
Numbers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SlaveFacets:
    """The facets of a slave's surface that this rank owns.

    Attributes
    ----------
    facets : Facets
        Undeformed or deformed.
    nodes : (n,) integer array
        Global nodes of the rows of ``facets.points``, ascending; of degree 2 with those in the
        middle of edges and facets.
    normals : (f, v, gdim) array
        The slave's normals at the corners of the facets.
    weight : (f, v) array or None
        Weight of the measure at the corners.
    """

    facets: Facets
    nodes: Numbers
    normals: Vector
    weight: Vector | None

    @staticmethod
    def of(
        space: FunctionSpace,
        slave: Surface,
        points: Vector,
        normal: Vector,
        weight: Vector | None,
    ) -> SlaveFacets:
        """Return the facets of a surface, their nodes numbered from 0.

        Parameters
        ----------
        space : FunctionSpace
            The displacement's space.
        slave : Surface
            The surface.
        points : (nodes, gdim) array
            All local nodes of the space [m].
        normal : (k, gdim) array
            Normals at the surface's nodes that this rank owns.
        weight : (nodes,) array or None
            Weight of the measure at all local nodes.
        """
        local = np.unique(slave.facet_nodes)
        numbers = space.dofmap.index_map.local_to_global(local.astype(np.int32))
        nodes = np.asarray(numbers, dtype=np.int64)
        order = np.argsort(nodes)
        at = np.zeros(local.size, dtype=np.int64)
        at[order] = np.arange(local.size)
        facets = Facets(points[local[order]], at[np.searchsorted(local, slave.facet_nodes)])
        normals = values_on_facets(space, slave, normal)
        at_corners = None if weight is None else weight[slave.vertices]
        return SlaveFacets(facets, nodes[order], normals, at_corners)


@dataclass(frozen=True)
class MortarConditions:
    """Mortar conditions at the slave nodes that this rank owns.

    Attributes
    ----------
    slave : (k,) integer array
        Global nodes, ascending.
    terms : MortarTerms
        Their terms.
    gap : (k, gdim) array
        Mean vectors from the slave to the master [m].
    area : (k,) array
        Integrals of the dual functions, with the weight of the measure.
    chord : (k,) array
        Largest distance of the facets of both surfaces there from curved surfaces through their
        nodes [m].
    angle : (k,) array
        Largest angle there between the normals of a slave facet and the opposite of those of the
        master facets over it [degrees].
    covered : (f,) bool array
        Which of this rank's slave facets are covered, at least in part.
    covered_area : float
        The covered area of this rank's slave facets, without weight [m^2 or m].
    """

    slave: Numbers
    terms: MortarTerms
    gap: Vector
    area: Vector
    chord: Vector
    angle: Vector
    covered: Mask
    covered_area: float


def mortar_conditions(
    comm: MPI.Intracomm,
    slave: SlaveFacets,
    owned: Numbers,
    master: DeformedSurface,
    normals: Vector,
    free: Numbers,
) -> MortarConditions:
    """Integrate over the slave's facets and sum up at the owners of its nodes. Collective.

    Parameters
    ----------
    comm : MPI.Intracomm
        The ranks.
    slave : SlaveFacets
        This rank's facets.
    owned : (s,) integer array
        The slave's nodes that this rank owns, ascending.
    master : DeformedSurface
        The master's surface near this rank's facets.
    normals : (n, gdim) array
        Its normals.
    free : integer array
        Nodes of the slave without condition.
    """
    other = master.surface
    integrals = integrate(slave.facets, other, slave.weight)
    has_row = _well_covered(comm, slave, integrals) & ~np.isin(slave.nodes, free)
    return _conditions(comm, slave, owned, master, normals, integrals, has_row)


def tied_conditions(
    comm: MPI.Intracomm,
    slave: SlaveFacets,
    owned: Numbers,
    master: DeformedSurface,
    normals: Vector,
    held: Mask,
) -> list[MortarConditions]:
    """Return the conditions for each component of surfaces that stay together. Collective.

    Where a component is prescribed at a node of the slave, the node has no condition on it unless
    the component is prescribed at all nodes of a facet: a condition would hold the master more than
    the support does.

    Parameters
    ----------
    comm, slave, owned, master, normals
        As in `mortar_conditions`.
    held : (f, v, gdim) bool array
        Which components are prescribed at the corners of this rank's facets.

    Returns
    -------
    list of MortarConditions
        One for each component.
    """
    other = master.surface
    integrals = integrate(slave.facets, other, slave.weight)
    well = _well_covered(comm, slave, integrals)
    gdim = held.shape[2]
    whole = np.broadcast_to(held.all(axis=1, keepdims=True), held.shape)
    directory = Directory(comm, slave.nodes)
    keys, flags = directory.collect(
        slave.nodes[slave.facets.corners.ravel()],
        np.concatenate([whole, held], axis=2).reshape(-1, 2 * gdim),
    )
    table = np.zeros((directory.keys.size, 2 * gdim), dtype=bool)
    np.logical_or.at(table, directory.position(keys), flags)
    flags = directory.lookup(slave.nodes, table)[1]
    has_row = well[:, None] & (flags[:, :gdim] | ~flags[:, gdim:])
    # of degree 2 the solution is more exact with the shape functions as multipliers
    dual = slave.facets.per_facet == 1
    return [
        _conditions(comm, slave, owned, master, normals, integrals, has_row[:, axis], dual)
        for axis in range(gdim)
    ]


def _conditions(
    comm: MPI.Intracomm,
    slave: SlaveFacets,
    owned: Numbers,
    master: DeformedSurface,
    normals: Vector,
    integrals: FacetIntegrals,
    has_row: Mask,
    dual: bool = True,
) -> MortarConditions:
    """Sum up the conditions of some nodes at their owners. Collective."""
    other = master.surface
    matrices = mortar_matrices(integrals, slave.facets, other, has_row, dual)
    to_owners = Directory(comm, owned)
    D, M = matrices.D.tocoo(), matrices.M.tocoo()
    nodes, terms = collect_terms(
        to_owners,
        np.concatenate([slave.nodes[D.row], slave.nodes[M.row]]),
        np.concatenate([slave.nodes[D.col], master.nodes[M.col]]),
        np.concatenate([D.data, -M.data]),
        np.repeat([True, False], [D.nnz, M.nnz]),
    )
    rows = np.flatnonzero(matrices.area > 0.0)
    at, gap, area = to_owners.forward(slave.nodes[rows], matrices.gap[rows], matrices.area[rows])
    at = np.searchsorted(nodes, at)
    sums = np.zeros((nodes.size, gap.shape[1] + 1))
    np.add.at(sums, at, np.column_stack([gap, area]))
    chord, angle = _largest_at_nodes(to_owners, slave, other, normals, integrals, nodes)
    covered = np.zeros(len(slave.facets), dtype=bool)
    covered[integrals.facet] = True
    return MortarConditions(
        nodes,
        terms,
        sums[:, :-1] / sums[:, -1:],
        sums[:, -1],
        chord,
        angle,
        covered,
        float(integrals.covered.sum()),
    )


def _well_covered(comm: MPI.Intracomm, slave: SlaveFacets, integrals: FacetIntegrals) -> Mask:
    """Tell which of this rank's nodes (n,) the master covers enough for a condition."""
    directory = Directory(comm, slave.nodes)
    keys, areas = directory.collect(
        slave.nodes, np.column_stack(node_areas(integrals, slave.facets))
    )
    total = np.zeros((directory.keys.size, 2))
    np.add.at(total, directory.position(keys), areas)
    whole, covered = directory.lookup(slave.nodes, total)[1].T
    well: Mask = covered > HARDLY_COVERED * whole
    return well


def collect_terms(
    to_owners: Directory, row: Numbers, column: Numbers, value: Vector, of_slave: Mask
) -> tuple[Numbers, MortarTerms]:
    """Sum up terms at the owners of their rows. Collective.

    Parameters
    ----------
    to_owners : Directory
        Of the slave's nodes that the ranks own.
    row, column : (t,) integer arrays
        Global nodes: the slave node of the condition, and the node of the term.
    value : (t,) array
        The weight, negative on the master [m^2 or m].
    of_slave : (t,) bool array
        Whether the term's node is one of the slave.

    Returns
    -------
    nodes, terms : (k,) integer array, MortarTerms
        The conditions that this rank owns, by ascending node.
    """
    row, column, value, of_slave = to_owners.forward(row, column, value, of_slave)
    # values in ascending order: the sum does not depend on the order in which they arrive
    order = np.lexsort((value, column, row))
    row, column, value, of_slave = row[order], column[order], value[order], of_slave[order]
    first = np.flatnonzero(
        np.diff(row, prepend=-1).astype(bool) | np.diff(column, prepend=-1).astype(bool)
    )
    if first.size:
        value = np.add.reduceat(value, first)
        of_slave = np.logical_or.reduceat(of_slave, first)
    row, column = row[first], column[first]
    # the node of the condition, other nodes of the slave, nodes of the master
    order = np.lexsort((column, column != row, ~of_slave, row))
    nodes, at = np.unique(row[order], return_inverse=True)
    number = np.bincount(at, minlength=nodes.size)
    slaves = np.bincount(at[of_slave[order]], minlength=nodes.size).astype(np.int64)
    offsets = np.append(0, np.cumsum(number)).astype(np.int64)
    return nodes, MortarTerms(offsets, column[order], value[order], slaves)


def _largest_at_nodes(
    to_owners: Directory,
    slave: SlaveFacets,
    master: Facets,
    normals: Vector,
    integrals: FacetIntegrals,
    nodes: Numbers,
) -> tuple[Vector, Vector]:
    """Return the largest chord heights and angles between facets around each condition's node.

    The angles are those between the planes of the facets' corners.
    """
    facet, other = integrals.facet[integrals.pair], integrals.master
    corners = slave.facets.points[slave.facets.corners]
    over = master.points[master.corners]
    of_master = chord_heights(over, normals[master.corners], _middles(master))
    chord = chord_heights(corners, slave.normals, _middles(slave.facets))
    planes, opposite = Planes.of(corners), Planes.of(over)
    angle = angles_between(planes.normal[facet], -opposite.normal[other])
    largest = np.zeros((len(corners), 2))
    np.maximum.at(largest, facet, np.column_stack([of_master[other], angle]))
    largest[:, 0] += chord
    covered = slave.facets.corners[integrals.facet]
    at, values = to_owners.forward(
        slave.nodes[covered.ravel()], np.repeat(largest[integrals.facet], covered.shape[1], axis=0)
    )
    there = np.isin(at, nodes)
    result = np.zeros((nodes.size, 2))
    np.maximum.at(result, np.searchsorted(nodes, at[there]), values[there])
    return result[:, 0], result[:, 1]


def _middles(surface: Facets) -> Vector | None:
    """Return the nodes (f, t - v, gdim) of facets of degree 2 that are no corners."""
    middles = surface.nodes[:, surface.number_of_corners :]
    return surface.points[middles] if middles.size else None
