"""Contacts and their conditions (sec. 11.1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fenics_tfeti.fem.contact.friction import FrictionLaw
from fenics_tfeti.fem.contact.obstacles import Obstacle
from fenics_tfeti.fem.contact.surfaces.tagged import Surface, VectorField
from fenics_tfeti.fem.nodes import NodeMap
from fenics_tfeti.feti.system import ContactRows
from fenics_tfeti.typing import Numbers, Vector

InitialGap = Literal["geometric", "touching"] | float | Callable[[Vector], ArrayLike]


@dataclass(frozen=True)
class ContactPair:
    """Two tagged surfaces that may touch but not penetrate each other.

    The meshes of the surfaces need not match, and each surface may extend beyond the other. Where
    every facet of the slave has a facet of the master opposite it with the same nodes, conditions
    are between pairs of nodes. Otherwise they are segment-based dual mortar conditions: one for
    each slave node that the master covers, on weighted means of the displacements.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave, master : int
        Tag of the slave's and of the master's surface. With mortar conditions the slave is better
        the softer surface, and of equally stiff ones that with the larger facets.
    name : str
        For messages and the report.
    discretisation : {"auto", "node_to_node", "mortar"}
        "auto" takes pairs of nodes where the meshes match, or where `direction`, `mapping` or
        `pairs` says how to find them, and mortar conditions otherwise. The choice is in the report.
        Displacements of degree 2 always have mortar conditions, with multipliers at the vertices.
    roles : {"auto", "given"}
        Whether `slave` and `master` are exchanged where mortar conditions are much better the other
        way round, or are as given. "auto" exchanges them where E / h of the slave, estimated from
        the stiffness matrices when the problem is set up, is more than four times that of the
        master; not where data of the slave are given: a `normal`, or an `initial_gap`, a `friction`
        or a `measure_weight` with values of functions; and not where the surfaces have no valid
        conditions the other way round. The report says what was done and why. The nodes of a
        `ContactResult` then are those of the master as given; all directions, and the resultants in
        the report, stay those on the slave as given.
    initial_gap : "geometric", "touching", float or callable
        The gap between the undeformed surfaces. By default it is that of the mesh. "touching" is
        for two meshes of one curved surface, whose facets gape or overlap by their distances from
        it: gaps up to that size are set to zero. A number or a function of x (3, n) that returns
        (n,) replaces the gap at the slave's nodes by a clearance (> 0) or an interference (< 0)
        [m], which the facets of curved surfaces would blur.
    tolerance : float
        Node to node: largest distance of a master node from the place where the slave node looks
        for it, relative to the edges of the slave's facets there. The distance is measured along
        the surface to the nearest node, across the `direction`, from the image by `mapping`, or
        from the points of `pairs` to the nodes.
    direction : (gdim,) array-like or callable, optional
        Node to node: partners are sought along this line, forwards and backwards, among the master
        nodes whose normals point against the slave's. A callable gets x (3, n) [m] and returns
        (gdim, n).
    mapping : callable, optional
        Node to node: chi of sec. 11.1: x (3, n) -> (3, n), the expected place of each slave node's
        partner [m].
    pairs : (slave points, master points), optional
        Node to node: arrays (k, 3) of coordinates [m], one row for each pair. The same on all
        ranks.
    normal : (gdim,) array-like or callable, optional
        Outward normals of the slave, of any length; a callable gets x (3, n) and returns (gdim, n).
        By default the area-weighted average of the facets' normals at each node.
    partial : bool
        Whether nodes that belong to slave and master stay free instead of being an error; node to
        node also slave nodes without partner, of which the report has the number. Mortar conditions
        leave slave nodes that the master does not cover free in any case.
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, by which nodal forces become pressures: ``2 * pi * r`` or
        ``r``, with ``r = SpatialCoordinate(mesh)[0]``, in axisymmetric forms, the thickness in
        forms of a thin sheet. By default 1. Mortar conditions integrate with it, linearly
        interpolated between the nodes of a facet.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none. In load steps slip is counted from the end of
        the last solve.
    """

    facet_tags: Any
    slave: int
    master: int
    name: str = ""
    tolerance: float = 0.1
    direction: VectorField | None = None
    mapping: Callable[[Vector], ArrayLike] | None = None
    pairs: tuple[ArrayLike, ArrayLike] | None = None
    normal: VectorField | None = None
    partial: bool = False
    measure_weight: Any = None
    discretisation: Literal["auto", "node_to_node", "mortar"] = "auto"
    initial_gap: InitialGap = "geometric"
    roles: Literal["auto", "given"] = "auto"
    friction: FrictionLaw | None = None


@dataclass(frozen=True)
class RigidObstacle:
    """A tagged surface that may touch but not penetrate a rigid obstacle.

    Attributes
    ----------
    facet_tags : MeshTags
        Tags of facets.
    slave : int
        Tag of the surface.
    obstacle : callable
        x -> (gap, normal) for points x of shape (3, n): the distance (n,) to the obstacle [m] and
        the unit normal (gdim, n) that points from the obstacle to the body. Or x -> gap alone, the
        distance along the surface's own outward normal. Where there is no obstacle, the gap is
        +inf and the normal is not used. `Plane`, `Sphere` and `Cylinder` are such callables.
    name : str
        For messages and the report.
    measure_weight : UFL expression or number, optional
        Factor of ``ds`` in the forms, see `ContactPair`. By default 1.
    friction : Tresca or Coulomb, optional
        The law of friction; by default there is none.
    displacement : (gdim,) array-like or callable, optional
        How far the obstacle has moved at each point since the undeformed state [m], for friction:
        slip is relative to the obstacle. A callable gets x (3, n) and returns (gdim, n). By default
        the obstacle is at rest. Where it moves along its normal, `obstacle` has to say so too.
    """

    facet_tags: Any
    slave: int
    obstacle: Obstacle
    name: str = ""
    measure_weight: Any = None
    friction: FrictionLaw | None = None
    displacement: VectorField | None = None


Contact = ContactPair | RigidObstacle


def contact_name(contact: Contact, number: int) -> str:
    """Return a contact's name, by default from its number and kind."""
    kind = "pair" if isinstance(contact, ContactPair) else "obstacle"
    return contact.name or f"contact {number} ({kind})"


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

    @cached_property
    def row(self) -> Numbers:
        """The row of each term, (t,)."""
        return np.repeat(np.arange(self.slaves.size), np.diff(self.offsets))

    @cached_property
    def scale(self) -> Vector:
        """The sum of the slave's weights of each row, (k,)."""
        position = np.arange(self.nodes.size) - self.offsets[:-1][self.row]
        weights = np.where(position < self.slaves[self.row], self.weights, 0.0)
        return self._sums(weights[:, None])[:, 0]

    @cached_property
    def slave(self) -> Numbers:
        """The slave node of each row, (k,)."""
        slave: Numbers = self.nodes[self.offsets[:-1]]
        return slave

    @cached_property
    def master(self) -> Numbers:
        """The master node with the largest weight, the lowest of equal ones; -1 for none, (k,)."""
        order = np.lexsort((self.nodes, self.weights, self.row))
        nodes = self.nodes[order[self.offsets[:-1]]]
        return np.where(np.diff(self.offsets) > self.slaves, nodes, -1)

    def means(self, values: Vector) -> Vector:
        """Return the weighted sums (k, q) of values (t, q) at the terms' nodes, over the scale."""
        means: Vector = self._sums(self.weights[:, None] * values) / self.scale[:, None]
        return means

    def _sums(self, values: Vector) -> Vector:
        sums = np.zeros((self.slaves.size, values.shape[1]))
        np.add.at(sums, self.row, values)
        return sums


@dataclass(frozen=True)
class Conditions:
    """Conditions sum_k w_k u(node_k)'n <= gap times the scale; of ties equalities.

    The gap is (chi(x) - x)'n (11.7), of a mortar condition the mean with its dual function. The
    area belongs to the node: in a partial contact that of the facets whose nodes all have partners,
    where the node has such facets; of a mortar condition the integral of its dual function over the
    covered part. It is multiplied by the contact's `measure_weight`.
    """

    terms: Terms
    normal: Vector  # outward unit normals of the slave (k, gdim)
    gap: Vector  # (k,) [m]; infinite where there is no obstacle
    area: Vector  # (k,) [m^2 or m]

    @property
    def slave(self) -> Numbers:
        """Global nodes of the displacement's space, which this rank owns (k,)."""
        return self.terms.slave

    @property
    def master(self) -> Numbers:
        """Partners, or the masters with the largest weights; -1 for an obstacle (k,)."""
        return self.terms.master

    def rows(self, number: int) -> ContactRows:
        """Return them as those of the contact with a number."""
        terms = self.terms
        return ContactRows(
            terms.offsets,
            terms.nodes,
            terms.weights[:, None] * self.normal[terms.row],
            self.gap * terms.scale,
            np.full(terms.slaves.size, number),
            terms.slaves,
        )

    def relative(self, nodes: NodeMap, values: Vector) -> Vector:
        """Return mean values (k, q) of the slave less those of the master. Collective.

        The values (n, q) are at this rank's nodes, such as displacements or places [m].
        """
        return self.terms.means(nodes.values_at(values, self.terms.nodes))


@dataclass(frozen=True)
class ContactPairing(Conditions):
    """The conditions of a contact at the slave nodes that this rank owns."""

    name: str
    summary: dict[str, Any]  # the contact's entry of `Report.pairing`
    surface: Surface  # all of the slave's surface
    covered: NDArray[np.bool_]  # (f,): whether the surface's facets have partners at all nodes
    coverage: Vector | None = None  # (k,), see `ContactResult`; 1 by default
    # (s, gdim): components prescribed at the surface's nodes, for mortar conditions
    prescribed: NDArray[np.bool_] | None = None
    master_surface: Surface | None = None  # for mortar conditions

    @property
    def is_mortar(self) -> bool:
        """Whether the conditions are mortar conditions of two surfaces."""
        return self.prescribed is not None

    @cached_property
    def on_surface(self) -> Numbers:
        """The positions of the slave's nodes among those of the surface, (k,)."""
        return np.searchsorted(self.surface.nodes, self.slave)

    @property
    def coordinates(self) -> Vector:
        """The undeformed slave nodes (k, 3) [m]."""
        return self.surface.coordinates[self.on_surface]
