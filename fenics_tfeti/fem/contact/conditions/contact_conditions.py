"""Conditions of contacts (sec. 11.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from fenics_tfeti.fem.contact.descriptions.contacts import ContactPair
from fenics_tfeti.fem.contact.surfaces.normals import without_axial_tilt
from fenics_tfeti.fem.contact.surfaces.tagged import MeshBoundary, Surface, split
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import ContactRows, rows_of_terms, sum_by_row, terms_of_slaves
from fenics_tfeti.typing import Array, Mask, Numbers, Vector


@dataclass(frozen=True)
class Terms:
    """Sums of displacements with scalar weights: k sparse rows of t terms (node, weight).

    The terms of row i are those from offsets[i] up to offsets[i + 1]: first its slave node, then
    further slave nodes, then master nodes.
    """

    offsets: Numbers  # (k + 1,)
    nodes: Numbers  # global nodes of the displacement's space (t,)
    # (t,), negative on the master: 1 for single nodes, of mortar conditions integrals of dual times
    # shape functions [m^2 or m]
    weights: Vector
    slaves: Numbers  # numbers of terms of slave nodes (k,)

    @staticmethod
    def of_nodes(slave: Numbers, master: Numbers | None = None) -> Terms:
        """Return rows (1,) of slave nodes (k,), or (1, -1) of pairs of nodes."""
        ends = [slave] if master is None else [slave, master]
        weights = np.tile([1.0, -1.0][: len(ends)], slave.size)
        offsets = len(ends) * np.arange(slave.size + 1)
        nodes = np.stack(ends, axis=1).ravel()
        return Terms(offsets, nodes, weights, np.ones(slave.size, dtype=np.int64))

    @staticmethod
    def joined(parts: Sequence[Terms]) -> Terms:
        """Return the rows of several parts, one after the other."""
        lengths = [np.diff(part.offsets) for part in parts]
        nodes, weights, slaves = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("nodes", "weights", "slaves")
        )
        return Terms(np.append(0, np.concatenate(lengths).cumsum()), nodes, weights, slaves)

    def split(self, ends: Numbers) -> list[Terms]:
        """Return consecutive rows, from each of the ends up to the next."""
        parts = []
        for first, end in pairwise(ends):
            offsets, slaves = self.offsets[first : end + 1], self.slaves[first:end]
            terms = slice(offsets[0], offsets[-1])
            parts.append(
                Terms(offsets - offsets[0], self.nodes[terms], self.weights[terms], slaves)
            )
        return parts

    def replaced(self, other: Terms, place: Numbers) -> Terms:
        """Return rows of others, at the places (k,) there, but these where it is negative."""
        taken = place >= 0
        begin = np.where(taken, self.nodes.size + other.offsets[:-1][place], self.offsets[:-1])
        counts = np.where(taken, np.diff(other.offsets)[place], np.diff(self.offsets))
        offsets = np.append(0, np.cumsum(counts))
        terms = np.repeat(begin - offsets[:-1], counts) + np.arange(offsets[-1])
        nodes = np.concatenate([self.nodes, other.nodes])[terms]
        weights = np.concatenate([self.weights, other.weights])[terms]
        return Terms(offsets, nodes, weights, np.where(taken, other.slaves[place], self.slaves))

    @cached_property
    def row(self) -> Numbers:
        """The row of each term, (t,)."""
        return rows_of_terms(self.offsets)

    @property
    def slave(self) -> Numbers:
        """The slave node of each row, (k,)."""
        return self.nodes[self.offsets[:-1]]

    @property
    def on_slave(self) -> Mask:
        """Whether the node of each term is one of the slave, (t,)."""
        return terms_of_slaves(self.offsets, self.slaves)

    @cached_property
    def scale(self) -> Vector:
        """The sum of the slave's weights of each row, (k,)."""
        return self._sums(np.where(self.on_slave, self.weights, 0.0)[:, None])[:, 0]

    @cached_property
    def master(self) -> Numbers:
        """The master node with the largest weight, the lowest of equal ones; -1 for none, (k,)."""
        has_master = np.diff(self.offsets) > self.slaves
        if not has_master.any():
            return np.full(has_master.size, -1)
        order = np.lexsort((self.nodes, self.weights, self.row))
        return np.where(has_master, self.nodes[order[self.offsets[:-1]]], -1)

    def means(self, values: Vector) -> Vector:
        """Return the weighted sums (k, q) of values (t, q) at the terms' nodes, over the scale."""
        return self._sums(self.weights[:, None] * values) / self.scale[:, None]

    def rows(
        self, normal: Vector, gap: Vector, contact: int | Numbers, area: Vector | None = None
    ) -> ContactRows:
        """Return conditions along normals, with gaps of mean displacements [m], of contacts."""
        return ContactRows(
            self.offsets,
            self.nodes,
            self.weights[:, None] * normal[self.row],
            gap * self.scale,
            np.full(self.slaves.size, contact),
            self.slaves,
            area,
        )

    def _sums(self, values: Vector) -> Vector:
        return sum_by_row(self.row, values, self.slaves.size)


@dataclass(frozen=True)
class JoinedPairs:
    """The surfaces of several pairs as one slave and one master, whose nodes are `ContactNodes`."""

    contacts: Sequence[ContactPair]
    slave: Surface
    master: Surface

    @property
    def partial(self) -> Mask:
        """Whether nodes may be on both surfaces or have no partner, of each pair."""
        return np.array([contact.partial for contact in self.contacts])


@dataclass(frozen=True)
class Accuracy:
    """How well k conditions fit their surfaces."""

    # (k,): largest distance of facets there from curved surfaces through their nodes [m]
    chord: Vector
    angle: Vector  # (k,): largest angle between normals and those opposite [degrees]
    # covered area of this rank's slave facets of each contact, without weight [m^2 or m]
    covered_area: Array
    # (k,): of mortar conditions the chord less the curvature of the facets [m]
    deviation: Vector | None = None
    distance: Vector | None = None  # (k,): of nodes what the tolerance limits [m]


@dataclass(frozen=True)
class PressureShares:
    """Shares of all nodes in mortar conditions, see `mean_traction`: only results need them."""

    make: Callable[[], sp.csr_matrix]

    @cached_property
    def matrix(self) -> sp.csr_matrix:
        """The shares (k, n). The first time collective."""
        return self.make()

    def rows(self, begin: int, end: int) -> sp.csr_matrix:
        """Return some of the rows. The first time collective."""
        return self.matrix[begin:end]


@dataclass(frozen=True)
class Conditions:
    """Conditions between two surfaces at the k slave nodes that this rank owns."""

    terms: Terms  # by ascending slave node
    # (k, gdim): unit normals; of mortar conditions the means with the dual functions
    normal: Vector
    gap: Vector  # (k, gdim): from the slave to the master, of mortar conditions the means [m]
    area: Vector  # (k,): see `ContactPairing`
    coverage: Vector  # (k,): covered share of the area that belongs to the node
    covered: Mask  # (f,): whether this rank's slave facets are covered, at least in part
    accuracy: Callable[[], Accuracy]  # collective
    shares: PressureShares | None = None


@dataclass(frozen=True)
class ObstacleConditions:
    """The k conditions of surfaces at obstacles, undeformed or deformed, of this rank."""

    terms: Terms
    normal: Vector  # (k, gdim): unit normals into the obstacle
    gap: Vector  # (k,): distances from the obstacle, of degree 2 the means around the nodes [m]
    area: Vector  # (k,) [m^2 or m]
    coverage: Vector  # (k,): ones
    covered: Mask  # (f,): facets that are opposite the obstacle
    shares: None = None


@dataclass(frozen=True)
class ContactConditions:
    """Conditions sum_k w_k u(node_k)'n <= gap times the scale, at slave nodes of this rank.

    The gap is (chi(x) - x)'n (11.7), of a mortar condition the mean with its dual function. The
    area belongs to the node: in a partial contact that of the facets whose nodes all have partners
    or are the master's, too, where the node has such facets; of a mortar condition the integral of
    its dual function over the covered part. Areas are those of the surface where the conditions are
    made, deformed or not, with the weight of the measure there.
    """

    terms: Terms
    normal: Vector  # outward unit normals of the slave (k, gdim)
    gap: Vector  # (k,) [m]; infinite where there is no obstacle
    area: Vector  # (k,) [m^2 or m]
    summary: dict[str, Any]  # the contact's entry of `ContactEntry.matching`
    surface: Surface  # all of the slave's surface
    covered: Mask  # (f,): whether the surface's facets have partners at all nodes
    coverage: Vector  # (k,), see `ContactResult`
    # (s, gdim): components prescribed at the surface's nodes, for mortar conditions
    prescribed: Mask | None = None
    master_surface: Surface | None = None  # None for obstacles
    # (s, 3): at the surface's nodes, if those in contact are on a round cylinder
    axes: Vector | None = None
    shares: PressureShares | None = None  # of mortar conditions
    made_on: MeshBoundary | None = None  # deformed; None for the undeformed surfaces

    @property
    def name(self) -> str:
        """The name of the contact."""
        return self.surface.names[0]

    @property
    def is_mortar(self) -> bool:
        """Whether the conditions are mortar conditions of two surfaces."""
        return self.prescribed is not None

    @property
    def slave(self) -> Numbers:
        """Global nodes of the displacement's space, which this rank owns (k,)."""
        return self.terms.slave

    @property
    def master(self) -> Numbers:
        """Partners, or the masters with the largest weights; -1 for an obstacle (k,)."""
        return self.terms.master

    @property
    def surfaces(self) -> list[Surface]:
        """The surfaces of slave and master."""
        both = (self.surface, self.master_surface)
        return [surface for surface in both if surface is not None]

    @cached_property
    def on_surface(self) -> Numbers:
        """The positions of the slave's nodes among those of the surface, (k,)."""
        return self.surface.rows_of(self.slave)

    @property
    def coordinates(self) -> Vector:
        """The undeformed slave nodes (k, 3) [m]."""
        return self.surface.coordinates[self.on_surface]

    @cached_property
    def stretch(self) -> Vector | float:
        """The area (k,) around the nodes where the conditions are made over the undeformed one.

        The first time collective.
        """
        if self.made_on is None:
            return 1.0
        return self.surface.stretch(self.made_on, self.covered)[self.on_surface]

    def mean_jumps(self, values: Vector) -> Vector:
        """Return values (owned, gdim) at the slave less those opposite it (k, gdim). Collective."""
        nodes = self.surface.boundary.nodes
        return self.terms.means(nodes.values_at(values, self.terms.nodes))

    def across(self, axes: Vector | None) -> ContactConditions:
        """Return the conditions with normals across axes (s, 3) at the surface's nodes, if any."""
        if axes is None:
            return self
        return replace(self, normal=without_axial_tilt(self.normal, axes[self.on_surface]))

    def with_areas_of(self, deformed: MeshBoundary) -> ContactConditions:
        """Return the conditions with the areas of another state. Collective."""
        there = replace(self, made_on=deformed)
        return replace(there, area=self.area / self.stretch * there.stretch)

    def relative(self, values: Vector) -> Vector:
        """Return means (k, q) of values (n, q), the slave's less the master's. Collective."""
        return self.terms.means(self.surface.boundary.nodes.values_at(values, self.terms.nodes))

    def mean_traction(self, force: Vector) -> Vector:
        """Return the tractions (k, ...) that are reported for forces (k, ...). Collective."""
        shares = None if self.shares is None else self.shares.matrix
        return mean_traction(self.surface.boundary.nodes, shares, force, self.area)


def mean_traction(
    nodes: NodeMap, shares: sp.csr_matrix | None, force: Vector, area: Vector
) -> Vector:
    """Return the tractions (k, ...) of forces (k, ...) and areas (k,) of conditions. Collective.

    With the shares S (k, n) of all nodes in the conditions, the traction t_j = sum_i S_ji t_i is a
    mean of those at nodes, t_i = sum_j S_ji f_j / sum_j S_ji a_j: that sum_j t_j a_j is the
    resultant, and a uniform traction uniform. Without shares it is f_j / a_j.
    """
    columns = np.column_stack([force, area])
    if shares is not None:
        # by entries in place of nodes, which may be those of other ranks
        size = (area.size, shares.nnz)
        S = sp.csr_matrix((shares.data, np.arange(shares.nnz), shares.indptr), shape=size)
        columns = nodes.values_at(
            nodes.reduce_at_owners(shares.indices, S.T @ columns), shares.indices
        )
    traction = columns[:, :-1] / columns[:, -1:]
    return (traction if shares is None else S @ traction).reshape(force.shape)


def separated(
    boundary: MeshBoundary, slave: Surface, found: Conditions | ObstacleConditions, gap: Vector
) -> list[dict[str, Any]]:
    """Return the conditions of each contact, with gaps (k,), in the mesh's numbers. Collective."""
    copies, count = slave.boundary.nodes, len(slave.names)
    numbers = copies.copied(boundary.nodes.first + np.arange(boundary.nodes.size))
    terms = replace(found.terms, nodes=copies.values_at(numbers, found.terms.nodes))
    contact = slave.contact[slave.rows_of(found.terms.slave)]
    ends = np.searchsorted(contact, np.arange(count + 1))
    shares: list[PressureShares | None] = [None] * count
    if found.shares is not None:
        of_mesh = PressureShares(
            partial(_shares_of_mesh, found.shares, copies, numbers, boundary.nodes.total)
        )
        shares = [PressureShares(partial(of_mesh.rows, *cut)) for cut in pairwise(ends)]
    columns = {
        "terms": terms.split(ends),
        "normal": split(contact, found.normal, count),
        "gap": split(contact, gap, count),
        "area": split(contact, found.area, count),
        "covered": split(slave.facet_contact, found.covered, count),
        "coverage": split(contact, found.coverage, count),
        "shares": shares,
    }
    return [dict(zip(columns, part, strict=True)) for part in zip(*columns.values(), strict=True)]


def _shares_of_mesh(
    shares: PressureShares, copies: NodeMap, numbers: Numbers, total: int
) -> sp.csr_matrix:
    """Return the shares of copies of nodes with the mesh's numbers as columns. Collective."""
    S = shares.matrix
    columns = copies.values_at(numbers, S.indices)
    return sp.csr_matrix((S.data, columns, S.indptr), (S.shape[0], total))


@dataclass(frozen=True)
class SlaveValues:
    """Values at slave nodes of contacts that this rank owns; zero at other nodes."""

    # by the contact's key, see `contact_keys`: nodes (k,), by their local numbers, and values there
    # (k, *shape)
    of_contact: Mapping[str, tuple[Numbers, Array]] = field(default_factory=dict)
    shape: tuple[int, ...] = ()

    @staticmethod
    def of(
        keys: Sequence[str], parts: Iterable[tuple[Numbers, Array]], shape: tuple[int, ...] = ()
    ) -> SlaveValues:
        """Return values of parts with keys; of several at a node with the same key the first."""
        of_contact = dict[str, tuple[Numbers, Array]]()
        for key, (nodes, values) in zip(keys, parts, strict=True):
            if key in of_contact:
                known, before = of_contact[key]
                nodes, values = np.concatenate([known, nodes]), np.concatenate([before, values])
                nodes, first = np.unique(nodes, return_index=True)
                values = values[first]
            of_contact[key] = nodes, values
        return SlaveValues(of_contact, shape)

    def at(self, key: str, nodes: Numbers) -> Array:
        """Return the values (q, *shape) at distinct nodes of a contact."""
        found = np.zeros((nodes.size, *self.shape))
        if key in self.of_contact:
            known, values = self.of_contact[key]
            _, rows, position = np.intersect1d(nodes, known, return_indices=True)
            found[rows] = values[position]
        return found


def contact_rows(
    all_conditions: Sequence[ContactConditions], gdim: int, numbers: Sequence[int] | None = None
) -> ContactRows:
    """Return the conditions of all contacts, by default numbered in their order, one by one."""
    if not all_conditions:
        return ContactRows.none(gdim)
    contacts = range(len(all_conditions)) if numbers is None else numbers
    normal, gap, area = (
        np.concatenate([getattr(p, name) for p in all_conditions])
        for name in ("normal", "gap", "area")
    )
    contact = np.repeat(contacts, [p.gap.size for p in all_conditions])
    return Terms.joined([p.terms for p in all_conditions]).rows(normal, gap, contact, area)


def row_values(
    nodes: NodeMap, rows: ContactRows, displacement: Vector, beyond: Vector | None = None
) -> Vector:
    """Return sum_k c_k'u(node_k) of rows (k,) whose nodes may be on any rank. Collective.

    The displacement (n,) is at the degrees of freedom that this rank owns [m]; `beyond` (b, gdim)
    are those of nodes with the numbers beyond those of the mesh, the same on all ranks. Nodes
    beyond these have no part in the sums.
    """
    beyond = np.zeros((0, nodes.components)) if beyond is None else beyond
    in_mesh = rows.nodes < nodes.total
    nodal = np.zeros((rows.nodes.size, nodes.components))
    nodal[in_mesh] = nodes.values_at(
        displacement.reshape(-1, nodes.components), rows.nodes[in_mesh]
    )
    known = ~in_mesh & (rows.nodes < nodes.total + len(beyond))
    nodal[known] = beyond[rows.nodes[known] - nodes.total]
    terms = np.sum(rows.coefficients * nodal, axis=1)
    return np.bincount(rows.row, terms, rows.size).astype(np.float64, copy=False)
