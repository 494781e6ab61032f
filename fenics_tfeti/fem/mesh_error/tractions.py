"""Tractions between cells with which each cell is in equilibrium.

Tractions are given by moments: integrals with the shape functions of a facet's nodes. They are
nearest to the stresses of both cells, and balance the forces of each cell node by node. Facets of
contacts and ties carry the forces that are missing in the balance of all cells at a node.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fenics_tfeti.errors import InputError, format_point
from fenics_tfeti.fem.geometry.batches import batches
from fenics_tfeti.fem.mesh_error.cell_loops import balance_nodes, ordered
from fenics_tfeti.fem.mesh_error.faces import CellFaces, add_rows
from fenics_tfeti.fem.mesh_error.node_problems import (
    CellForces,
    FacetMoments,
    balanced_moments,
    moments_over_ranks,
    on_several_ranks,
)
from fenics_tfeti.fem.mesh_error.stress import CellStress
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.fem.topology import global_numbers
from fenics_tfeti.parallel import Directory, any_rank, largest_of_ranks
from fenics_tfeti.typing import Array, Indices, Mask, Numbers, Vector

# numbers of the stresses that are computed at once
_NUMBERS = 2**18
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
        fixed[faces.nodes_at(np.nonzero(at_rigid)).ravel()] = True
        fixed = over_ranks(nodes, fixed, np.logical_or)
        free = np.repeat(~single[:, :, None], faces.dim, axis=2)
        free[single] = fixed[faces.nodes_at(np.nonzero(single))].all(axis=1)
        return FacetKinds(contact, single, fixed, free)


@dataclass(frozen=True)
class Tractions:
    """Moments of the tractions on the facets of the cells, with contact forces shared in two ways.

    A node's force is shared by area among all its contact facets or, second, only among those all
    of whose vertices carry a force, where it has any.
    """

    moments: Vector  # (k, f, t, d): the first way [N]
    second: Vector  # (c, f, t, d): the second way, of cells where it differs
    place: Indices  # (k,): the row of each cell in `second`, or -1
    pressing: Mask  # (k, f): the contact facets all of whose vertices carry a force
    free: Mask  # (k, f, d): tractions that may be changed

    def of(self, rows: Numbers) -> Vector:
        """Return moments (g, f, t, d, v) of some cells, in v = 1 way where both are the same."""
        place = self.place[rows]
        differ = place >= 0
        moments = np.repeat(self.moments[rows][..., None], 2 if differ.any() else 1, axis=-1)
        if differ.any():
            moments[differ, ..., 1] = self.second[place[differ]]
        return moments


def equilibrated_tractions(
    faces: CellFaces,
    nodes: NodeMap,
    kinds: FacetKinds,
    own: Vector,
    residual: Vector,
    rounding: float,
) -> Tractions:
    """Find tractions for forces r = L - a(u, .) (k, n, d) of each cell [N]. Collective.

    `own` are moments (k, f, t, d) of the cells' own stress. Both change. Forces up to the rounding
    [N] are none.

    Raises
    ------
    InputError
        If forces act on nodes whose facets are neither supported nor of a contact or tie.
    """
    summed = np.zeros((nodes.size, faces.dim))
    for batch in batches(faces.size, _NUMBERS):
        add_rows(summed, faces.nodes[batch].ravel(), residual[batch].reshape(-1, faces.dim))
    force = np.where(kinds.fixed, 0.0, -over_ranks(nodes, summed))
    at_contact = np.zeros(nodes.size, dtype=bool)
    facets = np.nonzero(kinds.contact)
    at_contact[faces.nodes_at(facets).ravel()] = True
    force[~over_ranks(nodes, at_contact, np.logical_or)] = 0.0
    sizes = np.abs(force).max(axis=1, initial=0.0)
    loaded = sizes > _LOADED * largest_of_ranks(nodes.comm, sizes)
    pressing = np.zeros_like(kinds.contact)
    pressing[facets] = loaded[faces.corners_at(facets)].all(axis=1)
    known = ContactMoments.of(faces, nodes, kinds, pressing, force)
    sizes = np.array([residual.max(initial=0.0), -residual.min(initial=0.0)])
    largest = _UNBALANCED * largest_of_ranks(nodes.comm, sizes)
    problems = _TractionProblems(faces, nodes, kinds, residual, known, own)
    problems.solve()
    largest += largest_of_ranks(nodes.comm, np.array([rounding]))
    _check_balance(nodes, problems.imbalance, largest)
    return Tractions(*problems.moments(), pressing, kinds.free)


def over_ranks(nodes: NodeMap, values: Array, ufunc: np.ufunc = np.add) -> Array:
    """Return values (nodes, ...) of local nodes summed up over the ranks. Collective."""
    if nodes.comm.size == 1:
        return values
    numbers = nodes.to_global(np.arange(nodes.size))
    return nodes.values_at(nodes.reduce_at_owners(numbers, values, ufunc), numbers)


def _single(faces: CellFaces, nodes: NodeMap) -> Mask:
    """Tell which facets (k, f) have one deformable cell alone. Collective."""
    facet_map = faces.space.mesh.topology.index_map(faces.dim - 1)
    size = facet_map.size_local + facet_map.num_ghosts
    count = np.bincount(faces.facets.ravel(), minlength=size)
    if nodes.comm.size > 1:
        used = np.flatnonzero(count)
        numbers = global_numbers(facet_map, used)
        directory = Directory(nodes.comm, numbers)
        sums = directory.sums(numbers, count[used].astype(float))
        count[used] = directory.lookup(numbers, sums)[1]
    return np.asarray((count == 1)[faces.facets])


def own_moments(faces: CellFaces, stress: CellStress) -> Vector:
    """Return the moments (k, f, t, d) of each cell's own stress on its facets [N]."""
    rule, d = faces.stress_rule, faces.dim
    f, q, t = rule.traces.shape
    own = np.zeros((faces.size, f, t, d))
    for batch in batches(faces.size, max(1, _NUMBERS // (f * q * d * d))):
        T = stress.at(faces.cells[batch]).reshape(-1, f, q, d, d)
        normals = faces.weighted_normals(batch, rule)
        tractions = np.zeros((len(T), f, q, d))
        for j in range(d):
            tractions += T[..., j] * normals[..., j, None]
        for facet, point, node in np.ndindex(f, q, t):
            weight = rule.traces[facet, point, node]
            own[batch, facet, node] += weight * tractions[:, facet, point]
    return own


@dataclass(frozen=True)
class ContactMoments:
    """Moments (c, f, t, d, 2) of the forces on contact facets, shared in two ways, by cell."""

    rows: Numbers  # (c,): the cells
    moments: Vector  # [N]

    @staticmethod
    def of(
        faces: CellFaces, nodes: NodeMap, kinds: FacetKinds, pressing: Mask, force: Vector
    ) -> ContactMoments:
        """Share the forces (nodes, d) of contact nodes among their facets. Collective."""
        rows = np.flatnonzero(kinds.contact.any(axis=1))
        shares = _shares(faces, nodes, kinds.contact, pressing, rows)
        moments = shares[..., None, :] * force[faces.facet_nodes(rows)][..., None]
        # supports take the forces of prescribed components
        given = kinds.contact[rows][:, :, None] & ~kinds.free[rows]
        return ContactMoments(rows, moments * given[:, :, None, :, None])

    def at_nodes(self, faces: CellFaces) -> Vector:
        """Return their sums (c, n, d, 2) at the cells' nodes."""
        total = np.zeros((self.rows.size, faces.nodes.shape[1], faces.dim, 2))
        for number, closure in enumerate(faces.closure):
            total[:, closure] += self.moments[:, number]
        return total


def _shares(
    faces: CellFaces, nodes: NodeMap, contact: Mask, pressing: Mask, rows: Numbers
) -> Vector:
    """Return the shares (c, f, t, 2) of contact facets of c cells in nodes' forces. Collective."""
    at_nodes = faces.facet_nodes(rows)
    sizes = np.linalg.norm(faces.weighted_normals(rows), axis=3)
    areas = np.einsum("kfq,fqt->kft", sizes, np.abs(faces.rule.traces))
    shares = np.repeat((areas * contact[rows][:, :, None])[..., None], 2, axis=-1)
    has_pressing = np.zeros(nodes.size, dtype=bool)
    has_pressing[at_nodes[pressing[rows]].ravel()] = True
    has_pressing = over_ranks(nodes, has_pressing, np.logical_or)
    shares[..., 1] *= pressing[rows][:, :, None] | ~has_pressing[at_nodes]
    total = np.zeros((nodes.size, 2))
    add_rows(total, at_nodes.ravel(), shares.reshape(-1, 2))
    total = over_ranks(nodes, total)
    return shares / np.where(total > 0.0, total, 1.0)[at_nodes]


class _TractionProblems:
    """The problems of all nodes: moments in balance, nearest to those of the cells' own stress."""

    def __init__(
        self,
        faces: CellFaces,
        nodes: NodeMap,
        kinds: FacetKinds,
        residual: Vector,
        known: ContactMoments,
        own: Vector,
    ) -> None:
        """Take the moments (k, f, t, d) of the cells' own stress, which become those in balance."""
        topology = faces.space.mesh.topology
        self._faces, self._nodes, self._kinds, self._residual = faces, nodes, kinds, residual
        self._known, self._moments = known, own
        self._cell = global_numbers(topology.index_map(faces.dim), faces.cells)
        self._facet_map = topology.index_map(faces.dim - 1)
        self._at_nodes = known.at_nodes(faces)
        self._row_of = np.full(faces.size, -1, dtype=np.int32)
        self._row_of[known.rows] = np.arange(known.rows.size)
        # facets and their nodes at each node of a cell
        self._facets_at = [np.nonzero(faces.closure == a) for a in range(faces.nodes.shape[1])]
        self._second: list[tuple[Numbers, Numbers, Numbers, Vector]] = []
        self.imbalance = np.zeros((nodes.size, faces.dim))

    def solve(self) -> None:
        """Solve the problems of all nodes. Collective."""
        faces, nodes = self._faces, self._nodes
        differ = (self._at_nodes[..., 0] != self._at_nodes[..., 1]).any(axis=2)
        in_two_ways = np.zeros(nodes.size, dtype=bool)
        in_two_ways[faces.nodes[self._known.rows][differ]] = True
        in_two_ways = over_ranks(nodes, in_two_ways, np.logical_or)
        is_shared = on_several_ranks(nodes, faces.nodes.ravel())
        pairs = np.flatnonzero((in_two_ways & ~is_shared)[faces.nodes])
        self._keep(*self._tables(pairs), balanced_moments)
        if nodes.comm.size > 1:

            def over_the_ranks(
                forces: CellForces, moments: FacetMoments
            ) -> tuple[Vector, Numbers, Vector]:
                return moments_over_ranks(nodes, forces, moments)

            self._keep(*self._tables(np.flatnonzero(is_shared[faces.nodes])), over_the_ranks)
        self._solve_in_one_way(in_two_ways | is_shared)

    def _solve_in_one_way(self, skipped: Mask) -> None:
        """Solve the problems of all other nodes, in place."""
        faces, (f, t) = self._faces, self._faces.closure.shape
        force = self._residual
        force[self._known.rows] += self._at_nodes[..., 0]
        offset = np.full((len(self._facets_at), max(at[0].size for at in self._facets_at)), -1)
        for local, (facet, node) in enumerate(self._facets_at):
            offset[local, : facet.size] = facet * t + node
        imbalance = balance_nodes(
            skipped,
            ordered(faces.nodes, self._nodes.size),
            (faces.nodes.shape[1], f * t, offset),
            (t, faces.facets, self._kinds.free),
            force.reshape(-1, faces.dim, 1),
            self._moments,
            self._moments,
        )
        np.maximum(self.imbalance, imbalance, out=self.imbalance)

    def moments(self) -> tuple[Vector, Vector, Indices]:
        """Return the moments, those of the second way, and the row of each cell in these."""
        faces, known = self._faces, self._known
        place = np.full(faces.size, -1, dtype=np.int32)
        for k, *_ in self._second:
            place[k] = 0
        rows = np.flatnonzero(place == 0)
        place[rows] = np.arange(rows.size)
        second = self._moments[rows]
        for k, f, t, values in self._second:
            second[place[k], f, t] = values
        is_in = place[known.rows] >= 0
        second[place[known.rows[is_in]]] += known.moments[is_in][..., 1]
        self._moments[known.rows] += known.moments[..., 0]
        return self._moments, second, place

    def _tables(
        self, pairs: Numbers
    ) -> tuple[CellForces, FacetMoments, tuple[Numbers, Numbers, Numbers]]:
        """Return forces and moments of pairs of a cell and a node, in two ways of sharing.

        Their cells, facets and nodes follow.
        """
        faces, nodes = self._faces, self._nodes
        k, a = np.divmod(pairs, faces.nodes.shape[1])
        force = np.repeat(self._residual[k, a][..., None], 2, axis=-1)
        row = self._row_of[k]
        has_known = row >= 0
        force[has_known] += self._at_nodes[row[has_known], a[has_known]]
        node = nodes.to_global(faces.nodes[k, a])
        forces = CellForces(node, self._cell[k], force)
        of_pair, at = list[Numbers](), list[tuple[Numbers, Numbers]]()
        for local, (f, t) in enumerate(self._facets_at):
            here = np.flatnonzero(a == local)
            of_pair.append(np.repeat(here, f.size))
            at.append((np.tile(f, here.size), np.tile(t, here.size)))
        pair = np.concatenate(of_pair)
        f, t = (np.concatenate(column) for column in zip(*at, strict=True))
        facet = global_numbers(self._facet_map, faces.facets[k[pair], f])
        free, moment = self._kinds.free[k[pair], f], self._moments[k[pair], f, t]
        moments = FacetMoments(node[pair], self._cell[k[pair]], facet, free, moment)
        return forces, moments, (k[pair], f, t)

    def _keep(
        self,
        forces: CellForces,
        moments: FacetMoments,
        at: tuple[Numbers, Numbers, Numbers],
        balanced: Callable[[CellForces, FacetMoments], tuple[Vector, Numbers, Vector]],
    ) -> None:
        """Keep the moments in balance, and what is out of balance."""
        solved, node, missing = balanced(forces, moments)
        self._moments[at] = solved[..., 0]
        np.maximum.at(self.imbalance, self._nodes.to_local(node), missing)
        self._second.append((*at, solved[..., 1]))


def _check_balance(nodes: NodeMap, imbalance: Vector, largest: float) -> None:
    """Check that no forces above a size act on nodes alone. Collective."""
    sizes = np.linalg.norm(imbalance[: nodes.owned], axis=1)
    wrong = sizes > largest
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
