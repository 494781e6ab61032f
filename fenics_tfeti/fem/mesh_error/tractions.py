"""Tractions between cells with which each cell is in equilibrium.

Tractions are given by moments: integrals with the shape functions of a facet's nodes. They are
nearest to the stresses of both cells, and balance the forces of each cell node by node. Facets of
contacts and ties carry the forces that are missing in the balance of all cells at a node.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.mesh_error.faces import CellFaces, add_rows
from fenics_tfeti.fem.mesh_error.node_problems import CellForces, FacetMoments, balanced_moments
from fenics_tfeti.fem.mesh_error.stress import CellStress
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import batches, global_numbers
from fenics_tfeti.parallel import Directory, any_rank, largest_of_ranks
from fenics_tfeti.typing import Array, Mask, Vector

# cells whose own tractions are computed at once
_CELLS = 2**12
# nodes with a contact force have more of it than this, relative to the largest one
_LOADED = 1e-6
# forces that are out of balance, relative to the largest force of a cell, are those of a support or
# load at a point
_UNBALANCED = 1e-3


@dataclass(frozen=True)
class FacetKinds:
    """Forces on the facets of the k cells, and on their nodes."""

    contact: Mask  # (k, f): of contacts and ties
    single: Mask  # (k, f): with one cell alone
    fixed: Mask  # (nodes, d): prescribed components of local nodes
    free: Mask  # (k, f, d): tractions between cells, and of supports

    @staticmethod
    def of(
        faces: CellFaces, nodes: NodeMap, contact: Mask, exterior: Mask, fixed: Mask
    ) -> FacetKinds:
        """Find the facets with one cell, on the boundary or at rigid bodies. Collective.

        `exterior` (k, f) are those on the boundary of the mesh.
        """
        single = _single(faces, nodes)
        at_rigid = single & ~exterior
        fixed = fixed.copy()
        fixed[faces.facet_nodes()[at_rigid].ravel()] = True
        fixed = over_ranks(nodes, fixed, np.logical_or)
        support = fixed[faces.facet_nodes()].all(axis=2) & single[:, :, None]
        return FacetKinds(contact, single, fixed, ~single[:, :, None] | support)


@dataclass(frozen=True)
class Tractions:
    """Moments of the tractions on the facets of the cells, with contact forces shared in v ways.

    A node's force is shared by area among all its contact facets or, second, only among those all
    of whose vertices carry a force, where it has any.
    """

    moments: Vector  # (k, f, t, d, v) [N]
    pressing: Mask  # (k, f): the contact facets all of whose vertices carry a force
    free: Mask  # (k, f, d): tractions that may be changed


def equilibrated_tractions(
    faces: CellFaces, nodes: NodeMap, kinds: FacetKinds, stress: CellStress, residual: Vector
) -> Tractions:
    """Find tractions for forces r = L - a(u, .) (k, n, d) of each cell [N]. Collective.

    Raises
    ------
    InputError
        If forces act on nodes whose facets are neither supported nor of a contact or tie.
    """
    summed = np.zeros((nodes.size, faces.dim))
    add_rows(summed, faces.nodes.ravel(), residual.reshape(-1, faces.dim))
    force = np.where(kinds.fixed, 0.0, -over_ranks(nodes, summed))
    at_contact = np.zeros(nodes.size, dtype=bool)
    at_contact[faces.facet_nodes()[kinds.contact].ravel()] = True
    force[~over_ranks(nodes, at_contact, np.logical_or)] = 0.0
    sizes = np.abs(force).max(axis=1, initial=0.0)
    loaded = sizes > _LOADED * largest_of_ranks(nodes.comm, sizes)
    pressing = loaded[faces.facet_corners()].all(axis=2) & kinds.contact
    shares = _shares(faces, nodes, kinds.contact, pressing)
    known = shares[..., None, :] * force[faces.facet_nodes()][..., None]
    # supports take the forces of prescribed components
    known *= kinds.contact[:, :, None, None, None] & ~kinds.free[:, :, None, :, None]
    own = _own_moments(faces, stress)
    moments, imbalance = _balanced(faces, nodes, kinds, residual, known, own)
    _check_balance(nodes, imbalance, largest_of_ranks(nodes.comm, np.abs(residual)))
    return Tractions(moments, pressing, kinds.free)


def over_ranks(nodes: NodeMap, values: Array, ufunc: np.ufunc = np.add) -> Array:
    """Return values (nodes, ...) of local nodes summed up over the ranks. Collective."""
    if nodes.comm.size == 1:
        return values
    numbers = nodes.to_global(np.arange(nodes.size))
    return nodes.values_at(nodes.sum_at_owners(numbers, values, ufunc), numbers)


def _single(faces: CellFaces, nodes: NodeMap) -> Mask:
    """Tell which facets (k, f) have one deformable cell alone. Collective."""
    domain = faces.space.mesh
    numbers = global_numbers(domain.topology.index_map(faces.dim - 1), faces.facets).ravel()
    distinct, inverse, count = np.unique(numbers, return_inverse=True, return_counts=True)
    if nodes.comm.size > 1:
        directory = Directory(nodes.comm, distinct)
        _, count = directory.lookup(distinct, directory.sums(distinct, count.astype(float)))
    return np.asarray(count[inverse.ravel()] == 1).reshape(faces.facets.shape)


def _own_moments(faces: CellFaces, stress: CellStress) -> Vector:
    """Return the moments (k, f, t, d) of each cell's own stress on its facets [N]."""
    rule = faces.rule
    shape = (*rule.points.shape[:2], faces.dim, faces.dim)
    own = [np.zeros((0, *faces.closure.shape, faces.dim))]
    for batch in batches(faces.size, _CELLS):
        T = stress.at(faces.cells[batch]).reshape(-1, *shape)
        tractions = np.einsum("kfqij,kfqj->kfqi", T, faces.weighted_normals(batch))
        own.append(np.einsum("kfqi,fqt->kfti", tractions, rule.traces))
    return np.concatenate(own)


def _shares(faces: CellFaces, nodes: NodeMap, contact: Mask, pressing: Mask) -> Vector:
    """Return the shares (k, f, t, v) of contact facets in their nodes' forces. Collective."""
    shares = np.zeros((*contact.shape, faces.closure.shape[1], 2))
    rows = np.flatnonzero(contact.any(axis=1))
    at_nodes = faces.facet_nodes()
    sizes = np.linalg.norm(faces.weighted_normals(rows), axis=3)
    areas = np.einsum("kfq,fqt->kft", sizes, np.abs(faces.rule.traces))
    shares[rows] = (areas * contact[rows][:, :, None])[..., None]
    has_pressing = np.zeros(nodes.size, dtype=bool)
    has_pressing[at_nodes[pressing].ravel()] = True
    has_pressing = over_ranks(nodes, has_pressing, np.logical_or)
    shares[..., 1] *= pressing[:, :, None] | ~has_pressing[at_nodes]
    total = np.zeros((nodes.size, 2))
    add_rows(total, at_nodes[rows].ravel(), shares[rows].reshape(-1, 2))
    total = over_ranks(nodes, total)
    return shares / np.where(total > 0.0, total, 1.0)[at_nodes]


def _balanced(
    faces: CellFaces,
    nodes: NodeMap,
    kinds: FacetKinds,
    residual: Vector,
    known: Vector,
    own: Vector,
) -> tuple[Vector, Vector]:
    """Return all moments (k, f, t, d, v), and the imbalance (owned, d) of nodes. Collective."""
    topology = faces.space.mesh.topology
    force = np.repeat(residual[..., None], known.shape[-1], axis=-1)
    for number, closure in enumerate(faces.closure):
        force[:, closure] += known[:, number]
    cell = global_numbers(topology.index_map(faces.dim), faces.cells)
    node = nodes.to_global(faces.nodes)
    facet = global_numbers(topology.index_map(faces.dim - 1), faces.facets)
    k, f = np.nonzero(kinds.free.any(axis=2))
    t: int = faces.closure.shape[1]
    moments = known.copy()
    solved, imbalance = balanced_moments(
        nodes,
        CellForces(
            node.ravel(),
            np.repeat(cell, node.shape[1]),
            force.reshape(node.size, *force.shape[2:]),
        ),
        FacetMoments(
            node[k[:, None], faces.closure[f]].ravel(),
            np.repeat(cell[k], t),
            np.repeat(facet[k, f], t),
            np.repeat(kinds.free[k, f], t, axis=0),
            own[k, f].reshape(-1, faces.dim),
        ),
    )
    moments[k, f] += solved.reshape(k.size, t, *known.shape[3:])
    return moments, imbalance


def _check_balance(nodes: NodeMap, imbalance: Vector, largest: float) -> None:
    """Check that no forces act on nodes alone. Collective."""
    sizes = np.linalg.norm(imbalance, axis=1)
    wrong = sizes > _UNBALANCED * largest
    if not any_rank(nodes.comm, wrong):
        return
    worst = int(sizes.argmax()) if sizes.size else 0
    place = format_point(nodes.coordinates[worst]) if sizes.size else ""
    size, place = max(nodes.comm.allgather((float(sizes.max(initial=0.0)), place)))
    raise InputError(
        f"a force of {size:.4g} acts on the node at {place} alone: none of its facets is supported "
        "or is one of a contact or tie. The exact displacement has infinite energy there, and the "
        "error of the mesh cannot be estimated. Support, load or tie whole facets"
    )
